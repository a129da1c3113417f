// A training in the browser's own storage, so that it continues after a reload. Only this page reads it.

const NAME = "gsplat_edu";
const KEPT = "training";

// Resolves with the database of this page.
function opened() {
  return new Promise((resolve, reject) => {
    const request = indexedDB.open(NAME, 1);
    request.onupgradeneeded = () => request.result.createObjectStore(KEPT);
    request.onsuccess = () => resolve(request.result);
    request.onerror = () => reject(request.error);
  });
}

// Runs `act` with the object store in one transaction: all of it is written, or nothing.
async function within(mode, act) {
  const database = await opened();
  try {
    return await new Promise((resolve, reject) => {
      const transaction = database.transaction(KEPT, mode);
      const request = act(transaction.objectStore(KEPT));
      transaction.oncomplete = () => resolve(request?.result);
      transaction.onabort = transaction.onerror = () => reject(transaction.error);
    });
  } finally {
    database.close();
  }
}

// Keeps what a training begins with, and forgets the one before: its photos, points, settings and name.
export const keepCapture = (capture) =>
  within("readwrite", (kept) => {
    kept.clear();
    kept.put(capture, "capture");
  });

// Keeps the state of the training that `keepCapture` began: {iteration, bytes}.
export const keepState = (state) => within("readwrite", (kept) => kept.put(state, "state"));

// The kept training: {capture, state}; null if there is none that can continue.
export async function keptTraining() {
  const capture = await within("readonly", (kept) => kept.get("capture"));
  const state = await within("readonly", (kept) => kept.get("state"));
  return capture && state ? { capture, state } : null;
}

export const forget = () => within("readwrite", (kept) => kept.clear());

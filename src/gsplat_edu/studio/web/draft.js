// Unsaved edits. Those whose editor was left for another screen of this page come back by themselves. All are kept in the
// browser's storage as well, by the scene's digest, and are offered when the scene is edited again after the tab was closed.

import { button, h, patch } from "./dom.js";

const drafts = new Map(); // by entry: {text, base, scene}: the edits, the saved ones they began from, and their scene
const renamed = new Map(); // old names of entries

addEventListener("beforeunload", (event) => {
  if (drafts.size) event.preventDefault();
});

const keyOf = (scene) => `unsaved edits ${scene}`;

// What the browser's storage has of a scene; null if there is nothing, or nothing that can be read.
function storedDraft(scene) {
  try {
    const found = JSON.parse(localStorage.getItem(keyOf(scene)));
    return found && found.scene === scene && Array.isArray(JSON.parse(found.text).operations) ? found : null;
  } catch {
    return null;
  }
}

// Writes down what an editor has not saved, and forgets it once everything is saved. Returns a line if it cannot be kept.
export function writeDown(editor) {
  const {
    scene: { sha256: scene },
    stored: base,
  } = editor;
  const text = editor.text();
  const unsaved = text === base ? null : text;
  if (editor.undecided || editor.written === unsaved) return "";
  editor.written = unsaved;
  if (unsaved === null) {
    localStorage.removeItem(keyOf(scene));
    return "";
  }
  try {
    localStorage.setItem(keyOf(scene), JSON.stringify({ text, base, scene, time: Date.now() }));
  } catch {
    localStorage.removeItem(keyOf(scene)); // an older state would be offered as the last one
    return "The browser has no room for these unsaved edits. Save them before you close the tab.";
  }
  return "";
}

// Offers what an earlier tab did not save.
function offerStored(editor, place) {
  const draft = storedDraft(editor.scene.sha256);
  if (!draft || draft.text === editor.stored) return;
  editor.undecided = true;
  const end = (after) => () => {
    editor.undecided = false;
    localStorage.removeItem(keyOf(draft.scene));
    after?.();
    patch(place);
  };
  const time = new Date(draft.time).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
  const since = draft.base === editor.stored ? "" : ", but other edits were saved since";
  const restore = button(
    "Restore",
    end(() => load(editor, draft)),
  );
  patch(place, `There are unsaved changes from ${time}${since}. `, restore, " ", button("Forget", end()));
}

export const hasDraft = (entry) => drafts.has(entry);

// Notes the new name of an entry, under which the draft of an editor that is still open is kept.
export function follow(entry, made) {
  renamed.delete(made);
  renamed.set(entry, made);
  if (drafts.has(entry)) drafts.set(made, drafts.get(entry));
  drafts.delete(entry);
}

// Keeps what an editor has not saved; called before its frame goes.
export function keep(entry, editor) {
  if (!editor) return;
  const text = editor.text();
  if (text !== editor.stored)
    drafts.set(renamed.get(entry) ?? entry, { text, base: editor.stored, scene: editor.scene.sha256 });
}

// Replaces an editor's operations by those of a draft, which can be undone.
function load(editor, { text }) {
  const { operations } = JSON.parse(text);
  const { history } = editor;
  const same = operations.findIndex((operation, i) => JSON.stringify(operation) !== JSON.stringify(history.done[i]));
  const shared = same < 0 ? operations.length : same;
  editor.goToStep(shared);
  for (const operation of operations.slice(shared)) history.perform(operation);
  editor.stateChanged();
}

function download({ text }) {
  const made = h("a", {
    href: URL.createObjectURL(new Blob([text], { type: "application/json" })),
    download: "edits.json",
  });
  made.click();
  setTimeout(() => URL.revokeObjectURL(made.href), 60000); // the browser may still be reading
}

// Brings a kept draft back into an editor that has started. `place` shows what is to be decided, `changed()` tells others.
export function bringBack(entry, editor, place, changed) {
  const draft = drafts.get(entry);
  if (!draft) return offerStored(editor, place);
  const end = (after) => () => {
    drafts.delete(entry);
    localStorage.removeItem(keyOf(draft.scene));
    editor.undecided = false;
    after?.();
    patch(place);
    changed();
  };
  const discard = button("Discard them", end());
  editor.undecided = true;
  if (draft.scene !== editor.scene.sha256) {
    patch(
      place,
      "There are unsaved edits of an earlier state of this scene, which do not fit this one. ",
      button("Download them", () => download(draft)),
      " ",
      discard,
    );
  } else if (draft.base !== editor.stored) {
    patch(
      place,
      "There are unsaved edits in this tab, but other edits were saved since. ",
      button(
        "Use mine",
        end(() => load(editor, draft)),
      ),
      " ",
      discard,
    );
  } else {
    end(() => load(editor, draft))();
  }
}

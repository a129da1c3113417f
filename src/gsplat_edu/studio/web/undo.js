// Undo of what went to the trash, and of a training that a proposal of the doctor began: it is stopped, its run goes to the
// trash, and the page shows again what was shown before. The studio knows what began it, so every tab offers it until the
// result is kept or undone.

import { at, post, remove } from "./api.js";
import { announce, attempt, button, errorLine, h, patch, put } from "./dom.js";

const PATIENCE = 120000; // milliseconds; a training writes a checkpoint before it ends

// Resolves once a job has ended.
function ended(store, id) {
  return new Promise((resolve, reject) => {
    const look = () => {
      const view = store.jobs.get(id);
      if (view?.active) return;
      store.removeEventListener("change", look);
      clearTimeout(timer);
      resolve();
    };
    const timer = setTimeout(() => {
      store.removeEventListener("change", look);
      reject(new Error("The training has not stopped yet. Try again once it has."));
    }, PATIENCE);
    store.addEventListener("change", look);
    look();
  });
}

// Moves what an address names to the trash, and offers to undo that above every screen until something else is removed.
export async function discard(store, address, name) {
  const { trash } = await remove(address);
  const place = document.getElementById("removed");
  const line = errorLine();
  const hide = () => {
    patch(place);
    place.hidden = true;
  };
  const undo = button("Undo", () =>
    attempt(undo, line, async () => {
      const { entry } = await post(at("trash", trash, "restore"));
      const isJob = entry.startsWith("jobs/");
      await Promise.all([store.refresh(), isJob && store.readJobs()]);
      hide();
      announce(`${name} is back`);
      if (address === at(entry) && !isJob) location.hash = `#/${entry.split("/").map(encodeURIComponent).join("/")}`;
    }),
  );
  const away = button("Close", hide);
  patch(place, h("p", { class: "toast" }, h("span", {}, `${name} is in the trash.`), undo, away), line);
  place.hidden = false;
  await store.refresh();
}

// The screen on which the proposal was made; that of the capture if it is gone.
function before(store, { begun_at: place, work }) {
  const there = store.entry(...place.split("/")) ? place : work.inputs[0];
  const address = `#/${there.split("/").map(encodeURIComponent).join("/")}`;
  return there.startsWith("runs/") ? `${address}/judge` : address;
}

// A line with the button, on the screen of a run that was begun so; it is hidden on others.
export function undoBegun(store, entry) {
  const line = errorLine();
  const newest = () => store.jobsOf(entry.entry, "train")[0];
  const undo = button("", () =>
    attempt(undo, line, async () => {
      const { job } = newest();
      const address = at("jobs", job.id, "undo");
      while (!(await post(address, { created: job.created })).undone) await ended(store, job.id);
      announce(`${entry.name} is in the trash`);
      await store.refresh();
      location.hash = before(store, job);
    }),
  );
  const keep = button("Keep it", () =>
    attempt(keep, line, async () => {
      const { id } = newest().job;
      const heard = store.heard.get(id);
      store.answered(await post(at("jobs", id, "keep")), heard);
    }),
  );
  const said = h("span", {});
  const element = h("div", { class: "begun", hidden: true }, h("p", { class: "toast" }, said, undo, keep), line);
  return {
    element,
    update() {
      const view = newest();
      const label = view?.job.begun_by;
      put(undo, view?.active ? "Undo: stop it and go back" : "Undo: remove it and go back");
      put(said, label ? `The doctor's “${label}” began this training. Undo moves its run to the trash.` : "");
      element.hidden = !label && line.hidden;
    },
  };
}

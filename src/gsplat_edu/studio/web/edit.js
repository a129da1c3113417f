// The editor: our page of the scene with its tools, which saves through the API.

import { at, get, head } from "./api.js";
import { h, put } from "./dom.js";
import { bringBack, keep, writeDown } from "./draft.js";
import { frame } from "./frame.js";
import { newestOf } from "./mesh.js";

const WRITE = 1000; // milliseconds between two looks at what is not saved
const LOOK = 250; // milliseconds between two looks whether the editor has started

export function edit({ place, store, entry }) {
  const scene = frame(`editor of ${entry.name}`);
  scene.element.classList.add("tall");
  scene.cover(entry);
  const note = h("p", { class: "quiet", hidden: true });
  const draft = h("p", { class: "notice", role: "status" });
  const unkept = h("p", { class: "notice", role: "alert", hidden: true });
  place.append(
    note,
    draft,
    unkept,
    scene.element,
    h("p", { class: "quiet" }, "Save in the editor; then export with the edits. The scene itself stays as it is."),
    h("div", { class: "row" }, scene.full),
  );
  const page = `${at(entry.entry, "page")}?edit=1`;
  let [closed, started] = [false, false];
  const timer = setInterval(() => {
    if (!scene.editor) return;
    clearInterval(timer);
    bringBack(entry.entry, scene.editor, draft, () => store.changed());
    started = true; // what an earlier tab left has been read
  }, LOOK);
  const write = () => started && scene.editor && put(unkept, writeDown(scene.editor));
  const writing = setInterval(write, WRITE);
  addEventListener("pagehide", write);
  open();

  // With a mesh, if there is one that a page can show: what is measured snaps to it.
  async function open() {
    const { exports } = await get(at(entry.entry, "exports")).catch(() => ({ exports: [] }));
    const mesh = newestOf(exports, "mesh.glb");
    let address = mesh ? `${page}&surface=${encodeURIComponent(mesh.file)}&surface-of=${mesh.modified}` : page;
    if (mesh) {
      await head(address).catch(({ message, status }) => {
        if (![400, 404].includes(status)) return; // the frame asks again
        put(note, `The mesh is not shown. ${message}`);
        address = page;
      });
    }
    if (!closed) scene.show(address, "Loading the editor ...");
  }

  return {
    close() {
      closed = true;
      clearInterval(timer);
      clearInterval(writing);
      removeEventListener("pagehide", write);
      write();
      keep(entry.entry, scene.editor);
      scene.close();
    },
  };
}

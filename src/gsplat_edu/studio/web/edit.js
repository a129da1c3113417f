// The editor: our page of the scene with its tools, which saves through the API.

import { at, get, head } from "./api.js";
import { h, link, put } from "./dom.js";
import { frame } from "./frame.js";
import { addressOf } from "./library.js";
import { newestOf } from "./mesh.js";

export function edit({ place, entry }) {
  const scene = frame(`editor of ${entry.name}`);
  scene.element.classList.add("tall");
  const note = h("p", { class: "quiet", hidden: true });
  place.append(
    h("p", { class: "quiet" }, "Save in the editor; then export with the edits. The scene itself stays as it is."),
    note,
    scene.element,
    h("div", { class: "row" }, scene.full, link("Share it", `${addressOf(entry)}/share`, { class: "button" })),
  );
  const page = `${at(entry.entry, "page")}?edit=1`;
  let closed = false;
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
      scene.close();
    },
  };
}

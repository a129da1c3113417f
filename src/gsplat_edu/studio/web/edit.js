// The editor: our page of the scene with its tools, which saves through the API.

import { at } from "./api.js";
import { h, link } from "./dom.js";
import { frame } from "./frame.js";
import { addressOf } from "./library.js";

export function edit({ place, entry }) {
  const scene = frame(`editor of ${entry.name}`);
  scene.element.classList.add("tall");
  place.append(
    h("p", { class: "quiet" }, "Save in the editor; then export with the edits. The scene itself stays as it is."),
    scene.element,
    h("div", { class: "row" }, scene.full, link("Share it", `${addressOf(entry)}/share`, { class: "button" })),
  );
  scene.show(`${at(entry.entry, "page")}?edit=1`, "Loading the editor ...");
  return { close: () => scene.close() };
}

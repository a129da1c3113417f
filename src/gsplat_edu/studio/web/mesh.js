// The mesh of a run or a scene: a job that makes it, and a preview beside the splats.

import { at } from "./api.js";
import { attempt, button, errorLine, h, heading } from "./dom.js";
import { frame } from "./frame.js";
import { jobPlace, startJob } from "./jobs.js";

// The newest exported file of a format; null without one.
export const newestOf = (exports, format) =>
  exports.filter((one) => one.format === format).sort((a, b) => b.modified - a.modified)[0] ?? null;

export function meshes(store, entry) {
  const line = errorLine();
  const fields = {
    voxel: h("input", { id: "voxel", type: "number", min: 0, step: "any", placeholder: "by the photos" }),
    faces: h("input", {
      id: "faces",
      type: "number",
      min: 4,
      inputmode: "numeric",
      placeholder: "as many as there are",
    }),
  };
  const texture = h("input", { type: "checkbox" });
  const painted = h(
    "label",
    { class: "check", hidden: entry.kind !== "runs" },
    texture,
    " texture of the photos instead of a colour per vertex",
  );
  const make = h("button", {}, "Make a mesh");
  const coarse = button("Make a collider", () => attempt(coarse, line, () => start("collider.glb")), {
    title: "A coarse mesh for collisions in a game engine",
  });
  const job = jobPlace(store, entry.entry, ["mesh"]);
  const scene = frame(`mesh of ${entry.name} beside its splats`);
  scene.cover(entry);
  const look = button("Show beside the splats", () => open(), { hidden: true });
  const preview = h("div", { hidden: true }, scene.element, h("div", { class: "row" }, scene.full));
  let [surface, collider] = [null, null];

  function start(format) {
    const options = {};
    for (const [name, field] of Object.entries(fields)) if (field.value) options[name] = Number(field.value);
    if (texture.checked && format === "mesh.glb") options.texture = true;
    return startJob(store, { command: "mesh", subject: entry.entry, format, options });
  }

  // The address says which files are shown and of when, so that a new mesh replaces an old one.
  function open() {
    const files = [
      ["surface", surface],
      ["collider", collider],
    ].filter(([, found]) => found);
    const query = files.map(
      ([name, { file, modified }]) => `${name}=${encodeURIComponent(file)}&${name}-of=${modified}`,
    );
    preview.hidden = false;
    scene.show(`${at(entry.entry, "page")}?${query.join("&")}`, "Loading the mesh ...");
  }

  const form = h(
    "form",
    {
      onsubmit: (event) => {
        event.preventDefault();
        attempt(make, line, () => start("mesh.glb"));
      },
    },
    h(
      "details",
      {},
      h("summary", {}, "More"),
      h(
        "div",
        { class: "grid" },
        h("label", {}, "Edge of a voxel, in units of the scene", fields.voxel),
        h("label", {}, "Triangles", fields.faces),
      ),
      painted,
    ),
    h("div", { class: "row" }, make, coarse, look),
  );
  const hint =
    "Triangles of the surfaces, as a GLB for Blender, Unity and other programs. Training a scene for a mesh makes it smoother: an option of the capture's screen.";
  return {
    element: h(
      "section",
      { "aria-label": "mesh" },
      heading(2, "Mesh"),
      h("p", { class: "quiet" }, hint),
      form,
      line,
      job.element,
      preview,
    ),
    close: () => scene.close(),
    show(exports) {
      const before = `${surface?.file} ${surface?.modified} ${collider?.file} ${collider?.modified}`;
      [surface, collider] = [newestOf(exports, "mesh.glb"), newestOf(exports, "collider.glb")];
      look.hidden = !surface;
      const after = `${surface?.file} ${surface?.modified} ${collider?.file} ${collider?.modified}`;
      if (!preview.hidden && before !== after) {
        if (surface) open();
        else preview.hidden = true;
      }
    },
    update(now) {
      job.update();
      make.disabled = coarse.disabled = entry.kind === "runs" && !now.files;
    },
  };
}

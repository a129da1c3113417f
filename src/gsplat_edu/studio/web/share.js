// Exports of a run or a scene: every format with its size and PSNR, the page for others, a video.

import { at, get, remove } from "./api.js";
import { attempt, bytes, button, commandLine, decibels, errorLine, h, heading, keyed, link, put } from "./dom.js";
import { jobPlace, startJob } from "./jobs.js";
import { addressOf } from "./library.js";
import { meshes, newestOf } from "./mesh.js";

const FORMATS = [
  ["html", "HTML page", "one file that shows the scene in any browser, also offline"],
  ["spz", "SPZ", "small; many viewers read it"],
  ["sog", "SOG", "smallest; for SuperSplat and PlayCanvas"],
  ["ply", "PLY", "exact and large; every program reads it"],
  ["compressed.ply", "Compressed PLY", "a quarter of a PLY; for SuperSplat"],
  ["splat", "SPLAT", "without view-dependent colour"],
  ["glb", "GLB", "glTF with Gaussians"],
];

const isVideo = (file) => /\.mp4$/i.test(file);

export function share({ place, store, entry }) {
  const line = errorLine();
  const title = h("input", { id: "title", type: "text", required: true, value: entry.name, autocomplete: "off" });
  const edits = h("input", { type: "checkbox", checked: true });
  const withEdits = h("label", { class: "check", hidden: true }, edits, " apply the edits");
  const surface = h("input", { type: "checkbox" });
  const withMesh = h("label", { class: "check", hidden: true }, surface, h("span", {}));
  const note = h("p", { class: "quiet" });
  const choices = FORMATS.map(([value, name, hint], index) => {
    const input = h("input", { type: "radio", name: "format", value, checked: index === 0, onchange: () => explain() });
    return h("label", { class: "choice" }, input, h("strong", {}, name), h("span", { class: "quiet" }, hint));
  });
  const form = h("form", {});
  const make = h("button", { class: "primary" }, "Export");
  const film = button("Make a video", () => attempt(film, line, () => start({ command: "render" })));
  const job = jobPlace(store, entry.entry, ["convert", "render"], { main: true });
  const list = h("ul", { class: "plain exports", "aria-label": "exported files" });
  const none = h("p", { class: "quiet" }, "Nothing is exported yet.");
  const mesh = meshes(store, entry);
  let [read, now] = ["", entry];
  let shown = {}; // the newest surface and collider, which a page can show

  const start = (more) => {
    const edited = now.edited && edits.checked;
    return startJob(store, { subject: entry.entry, to: title.value, ...(edited ? { edits: true } : {}), ...more });
  };

  const isPage = () => new FormData(form).get("format") === "html";

  function explain() {
    const page = isPage();
    withMesh.hidden = !page || !shown.surface;
    put(note, page ? "The title is the page's heading. Start view, named views and camera path come from the edits: set them under Edit and save." : "");
  }

  form.append(
    h("fieldset", {}, h("legend", {}, "Format"), h("div", { class: "choices" }, choices)),
    h("p", { class: "row" }, h("label", { for: "title" }, "Title and name of the file"), title, withEdits, withMesh),
    note,
    h("div", { class: "row" }, make, film),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const format = new FormData(form).get("format");
    const files = isPage() && shown.surface && surface.checked ? Object.entries(shown).filter(([, found]) => found) : [];
    const along = Object.fromEntries(files.map(([name, { file }]) => [name, file]));
    attempt(make, line, () => start({ command: "convert", format, ...along }));
  });
  explain();
  place.append(
    h("section", { "aria-label": "export" }, heading(2, "Export"), form, line, job.element),
    h("section", { "aria-label": "exported files" }, heading(2, "Exported files"), none, list),
    mesh.element,
    entry.kind === "runs" ? cleaning(store, entry) : noCleaning(),
  );

  function item(found) {
    const { file, command } = found;
    const away = button("Remove", () =>
      attempt(away, line, async () => {
        await remove(at(entry.entry, "exports", file));
        read = "";
        store.refresh();
      }),
    );
    const address = at(entry.entry, "exports", file);
    return h(
      "li",
      {},
      h("div", { class: "row" }, h("strong", { class: "name" }, file), h("span", { class: "quiet facts" }), link("Download", address, { class: "button", download: file }), away),
      command ? h("details", {}, h("summary", {}, "The same as a command"), commandLine(command)) : null,
    );
  }

  function show(exports) {
    none.hidden = exports.length > 0;
    mesh.show(exports);
    shown = { surface: newestOf(exports, "mesh.glb"), collider: newestOf(exports, "collider.glb") };
    const size = Object.values(shown).reduce((sum, found) => sum + (found?.bytes ?? 0), 0);
    const what = shown.collider ? "mesh and the collider" : "mesh";
    put(withMesh.lastChild, ` show the ${what} beside the splats (about ${bytes(size)} more)`);
    explain();
    const newest = [...exports].sort((a, b) => b.modified - a.modified);
    keyed(list, newest, ({ file, modified, job: by }) => `${file} ${modified} ${by}`, item, (element, { file, bytes: size, psnr }) => {
      const exact = psnr === null ? "" : `PSNR ${decibels(psnr)} against the scene`;
      element.querySelector(".facts").textContent = [bytes(size), isVideo(file) ? "" : exact].filter(Boolean).join(" · ");
    });
  }

  return {
    close: () => mesh.close(),
    update(found) {
      now = found;
      withEdits.hidden = !now.edited;
      job.update();
      mesh.update(now);
      make.disabled = film.disabled = entry.kind === "runs" && !now.files;
      const states = store.jobsOf(entry.entry, "convert", "render", "mesh").map(({ job: { id, state } }) => `${id} ${state}`);
      const version = `${states} ${now.modified} ${now.files}`;
      if (version === read) return;
      read = version;
      // an answer that comes after that to a newer question is dropped
      get(at(entry.entry, "exports")).then(({ exports }) => version === read && show(exports), (error) => put(line, error.message));
    },
  };
}

// Removes what few photos saw, into a new scene.
function cleaning(store, entry) {
  const line = errorLine();
  const job = jobPlace(store, entry.entry, ["clean"]);
  const next = h("p", { hidden: true });
  const clean = button("Clean", () => attempt(clean, line, () => startJob(store, { command: "clean", subject: entry.entry })));
  const update = () => {
    if (!next.isConnected) return store.removeEventListener("change", update);
    job.update();
    const made = store.madeBy(job.view);
    if (made && next.hidden) next.append(link(`Open the scene ${made.name}`, addressOf(made), { class: "button" }));
    next.hidden = !made;
    return undefined;
  };
  store.addEventListener("change", update);
  setTimeout(update);
  return h(
    "section",
    { "aria-label": "cleaning" },
    heading(2, "Clean"),
    h("p", { class: "quiet" }, "Removes specks that float in the air and splats that no photo needs, and makes a new scene. The run stays as it is."),
    clean,
    line,
    job.element,
    next,
  );
}

// Why a scene alone cannot be cleaned.
function noCleaning() {
  return h(
    "section",
    { "aria-label": "cleaning" },
    heading(2, "Clean"),
    h("p", { class: "quiet" }, "Cleaning needs the photos and their cameras, which a scene file does not have: clean the run that made it. To remove splats by hand, open Edit."),
  );
}

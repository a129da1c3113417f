// Exports of a run or a scene: every format with its size and how it looks, the page for others, a video.

import { at, get } from "./api.js";
import {
  attempt,
  bytes,
  button,
  commandLine,
  decibels,
  errorLine,
  h,
  heading,
  link,
  patch,
  put,
  versioned,
  want,
} from "./dom.js";
import { hasDraft } from "./draft.js";
import { jobPlace, startJob } from "./jobs.js";
import { addressOf } from "./entries.js";
import { meshes, newestOf } from "./mesh.js";
import { SIZED } from "./questions.js"; // made by the server: the endings of files that a size can be given for
import { discard } from "./undo.js";

const FORMATS = [
  ["html", "HTML page", "one file that shows the scene in any browser, also offline"],
  ["spz", "SPZ", "small; many viewers read it"],
  ["sog", "SOG", "smallest; for SuperSplat and PlayCanvas"],
  ["ply", "PLY", "exact and large; every program reads it"],
  ["compressed.ply", "Compressed PLY", "a quarter of a PLY; for SuperSplat"],
  ["splat", "SPLAT", "without view-dependent colour"],
  ["glb", "GLB", "glTF with Gaussians"],
  ["laz", "LAZ", "the splats' centres as a point cloud; for CloudCompare, QGIS and CAD"],
];

const [SAME, CLOSE] = [40, 30]; // dB: root mean square differences of 1 % and of 3 % of the whole range

// How an exported file looks beside its scene.
function likeness(psnr) {
  if (psnr >= SAME) return "looks the same as your scene";
  return psnr >= CLOSE ? "looks nearly the same as your scene" : "looks different from your scene";
}

const isVideo = (file) => /\.mp4$/i.test(file);

export function share({ place, store, entry }) {
  const line = errorLine();
  const known = `title of ${entry.entry}`; // the browser remembers what was typed
  const title = h("input", {
    id: "title",
    type: "text",
    required: true,
    value: localStorage.getItem(known) ?? entry.name,
    autocomplete: "off",
    onchange: () => (title.value ? localStorage.setItem(known, title.value) : localStorage.removeItem(known)),
  });
  const most = h("input", { id: "most", type: "number", min: 0, step: "any", placeholder: "any size" });
  const withSize = h("label", {}, "At most (MB) ", most);
  const edits = h("input", { type: "checkbox", checked: true });
  const withEdits = h("label", { class: "check", hidden: true }, edits, " apply the edits");
  const surface = h("input", { type: "checkbox" });
  const withMesh = h("label", { class: "check", hidden: true }, surface, h("span", {}));
  const proof = h("input", { type: "checkbox" });
  const withProof = h(
    "label",
    { class: "check", hidden: true },
    proof,
    " let visitors check the scene: 12 of your photos (480 px, without file names or other data) beside the picture, and a switch that colours what fewer than two photos saw",
  );
  const unsaved = h(
    "p",
    { class: "notice", hidden: true },
    "Edits that are not saved yet are not exported. Save them under ",
    link("Edit", `${addressOf(entry)}/edit`),
    ".",
  );
  const note = h("p", { class: "quiet" });
  const choices = FORMATS.map(([value, name, hint], index) => {
    const input = h("input", { type: "radio", name: "format", value, checked: index === 0, onchange: () => explain() });
    return h("label", { class: "choice card" }, input, h("strong", {}, name), h("span", { class: "quiet" }, hint));
  });
  const form = h("form", { id: "export", "data-next": `convert ${entry.entry}` });
  const make = h("button", {}, "Export");
  const film = button("Make a video", () => attempt(film, line, () => start({ command: "render" })));
  const job = jobPlace(store, entry.entry, ["convert", "render"], { main: true });
  const list = h("ul", { class: "plain exports", "aria-label": "exported files" });
  const none = h("p", { class: "quiet" }, "Nothing is exported yet.");
  const mesh = meshes(store, entry);
  let now = entry;
  let shown = {}; // the newest surface and collider, which a page can show

  const start = async (more) => {
    await store.refresh(); // edits may have been saved just now
    const edited = (store.entry(entry.kind, entry.name) ?? now).edited && edits.checked;
    return startJob(store, { subject: entry.entry, to: title.value, ...(edited ? { edits: true } : {}), ...more });
  };

  const formatOf = () => new FormData(form).get("format");
  const isPage = () => formatOf() === "html";

  function explain() {
    const page = isPage();
    withMesh.hidden = !page || !shown.surface;
    withProof.hidden = !page || entry.kind !== "runs";
    withSize.hidden = !SIZED.includes(`.${formatOf()}`);
    put(
      note,
      page
        ? "The title is the page's heading. Start view, named views, guided tour (views with a text) and camera path come from the edits: set them under Edit and save."
        : "",
    );
  }

  form.append(
    h("fieldset", {}, h("legend", {}, "Format"), h("div", { class: "choices" }, choices)),
    h("p", { class: "row" }, h("label", { for: "title" }, "Title and name of the file"), title, withEdits, withMesh),
    h("p", { class: "row" }, withSize),
    withProof,
    note,
    unsaved,
    h("div", { class: "row" }, make, film),
  );
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const format = formatOf();
    const options = {
      ...(isPage() && !withProof.hidden && proof.checked ? { verify: "photos" } : {}),
      ...(!withSize.hidden && most.value ? { size: `${most.value}MB` } : {}),
    };
    const files =
      isPage() && shown.surface && surface.checked ? Object.entries(shown).filter(([, found]) => found) : [];
    const along = Object.fromEntries(files.map(([name, { file }]) => [name, file]));
    attempt(make, line, () =>
      start({ command: "convert", format, ...along, ...(Object.keys(options).length ? { options } : {}) }),
    );
  });
  explain();
  place.append(
    h("section", { "aria-label": "export" }, heading(2, "Export"), form, line, job.element),
    h("section", { "aria-label": "exported files" }, heading(2, "Exported files"), none, list),
    mesh.element,
    entry.kind === "runs" ? cleaning(store, entry, () => now) : noCleaning(),
  );

  function item({ file, command, modified, job: by, bytes: size, psnr }) {
    const onclick = ({ currentTarget }) =>
      attempt(currentTarget, line, async () => {
        await discard(store, at(entry.entry, "exports", file), file);
      });
    const href = at(entry.entry, "exports", file);
    const isCompared = psnr !== null && !isVideo(file);
    return want(
      "li",
      { "data-key": `${file} ${modified} ${by}`, class: "card" },
      want(
        "div",
        { class: "row" },
        want("strong", { class: "name" }, file),
        want(
          "span",
          { class: "quiet facts", title: isCompared ? `PSNR ${decibels(psnr)} against the scene` : null },
          [bytes(size), isCompared && likeness(psnr)].filter(Boolean).join(" · "),
        ),
        want("a", { href, class: "button", download: file }, "Download"),
        want("button", { type: "button", onclick }, "Move to the trash"),
      ),
      command ? want("details", {}, want("summary", {}, "The same as a command"), commandLine(command)) : null,
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
    patch(list, newest.map(item));
  }

  const exported = versioned(
    line,
    () => get(at(entry.entry, "exports")),
    ({ exports }) => show(exports),
  );

  return {
    close: () => mesh.close(),
    update(found) {
      now = found;
      withEdits.hidden = !now.edited;
      unsaved.hidden = !hasDraft(entry.entry);
      job.update();
      mesh.update(now);
      make.disabled = film.disabled = entry.kind === "runs" && !now.files;
      const states = store
        .jobsOf(entry.entry, "convert", "render", "mesh")
        .map(({ job: { id, state } }) => `${id} ${state}`);
      exported.read(`${states} ${now.modified} ${now.files}`);
    },
  };
}

// Removes what few photos saw, into a new scene with the run's edits.
function cleaning(store, entry, entryNow) {
  const line = errorLine();
  const job = jobPlace(store, entry.entry, ["clean"]);
  const found = h("ul", { class: "plain", "aria-label": "what was cleaned", hidden: true });
  const next = h("p", { hidden: true });
  const clean = button("Clean", () =>
    attempt(clean, line, async () => {
      await store.refresh(); // edits may have been saved just now
      const { edited } = store.entry(entry.kind, entry.name) ?? entryNow();
      return startJob(store, { command: "clean", subject: entry.entry, ...(edited ? { edits: true } : {}) });
    }),
  );
  const update = () => {
    if (!next.isConnected) return store.removeEventListener("change", update);
    job.update();
    const { view } = job;
    const said = view?.job.state === "done" ? view.messages.filter((text) => !/^wrote /.test(text)) : [];
    patch(
      found,
      said.map((text) => want("li", {}, text.trim().replace(/\s+/g, " "))),
    );
    found.hidden = !said.length;
    const made = store.madeBy(view);
    if (made) patch(next, want("a", { href: addressOf(made), class: "button" }, `Open the scene ${made.name}`));
    next.hidden = !made;
    return undefined;
  };
  store.addEventListener("change", update);
  setTimeout(update);
  return h(
    "section",
    { "aria-label": "cleaning" },
    heading(2, "Clean"),
    h(
      "p",
      { class: "quiet" },
      "Removes specks that float in the air and splats that no photo needs, and makes a new scene with the same edits. It renders each photo's view, which takes about a minute. The run stays as it is.",
    ),
    clean,
    line,
    job.element,
    found,
    next,
  );
}

// Why a scene alone cannot be cleaned.
function noCleaning() {
  return h(
    "section",
    { "aria-label": "cleaning" },
    heading(2, "Clean"),
    h(
      "p",
      { class: "quiet" },
      "Cleaning needs the photos and their cameras, which a scene file does not have: clean the run that made it. To remove splats by hand, open Edit.",
    ),
  );
}

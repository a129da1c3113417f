// The library: everything in the folder, with pictures and states.

import { at, get, post, remove } from "./api.js";
import { announce, attempt, bytes, button, count, decibels, errorLine, h, heading, keyed, link, put, whole } from "./dom.js";
import { intake } from "./intake.js";
import { badge } from "./jobs.js";

const PARTS = {
  photos: ["Photos", "Photos without poses. Drop some above; the first step finds where each was taken."],
  captures: ["Captures", "Photos with poses. They come from photos, or from other programs as a folder or zip file."],
  runs: ["Runs", "Trainings. Open a capture and start one."],
  scenes: ["Scenes", "Finished scenes of other programs, and cleaned ones. Drop a .ply, .spz, .splat, .sog or .glb file above."],
};

export const addressOf = ({ kind, name }) => `#/${kind}/${encodeURIComponent(name)}`;

// What an entry is, in a few words.
export function factsOf(entry) {
  const { kind } = entry;
  if (kind === "photos" || kind === "captures") {
    const videos = entry.videos ? count(entry.videos, "video") : "";
    const photos = entry.photos || !videos ? count(entry.photos, "photo") : "";
    return [photos, videos, kind === "captures" ? (entry.layout ?? "no poses found") : "", bytes(entry.bytes)];
  }
  if (kind === "scenes") return [entry.file ? entry.file.split(".").at(-1) : "no scene file", bytes(entry.scene_bytes)];
  const done = entry.iterations ?? 0;
  return [
    entry.finished ? `${whole(done)} iterations` : entry.planned ? `${whole(done)} of ${whole(entry.planned)} iterations` : "no iterations yet",
    entry.psnr === null ? "" : decibels(entry.psnr),
    entry.num_gaussians ? `${whole(entry.num_gaussians)} splats` : "",
    entry.edited ? "edited" : "",
  ];
}

// Address of a small picture of an entry; null if there is none.
async function pictureOf(entry) {
  if (entry.kind === "runs") {
    if (entry.psnr === null) return null; // nothing is rendered yet
    const { views } = await get(at(entry.entry, "views"));
    return views.length ? at(entry.entry, "views", String(views.at(-1).index), "render.jpg") : null;
  }
  if (!entry.photos) return null;
  const { photos } = await get(at(entry.entry, "photos"));
  const good = photos.find(({ problem }) => !problem);
  return good ? `${at(entry.entry, "thumbs", good.name)}?side=256` : null;
}

function card(entry) {
  const image = h("img", { alt: "", loading: "lazy", hidden: true, onerror: () => (image.hidden = true) });
  const element = h(
    "a",
    { class: "card", href: addressOf(entry) },
    h("span", { class: "thumb", "aria-hidden": "true" }, image),
    h("span", { class: "name" }, entry.name),
    h("span", { class: "facts quiet" }),
    h("span", { class: "states" }),
  );
  element.image = image;
  return element;
}

// Reads the picture again once the entry has changed.
function picture(element, entry) {
  const version = `${entry.modified} ${entry.files} ${entry.finished}`;
  if (element.version === version || entry.kind === "scenes") return;
  element.version = version;
  pictureOf(entry).then(
    (address) => {
      element.image.hidden = !address;
      if (address) element.image.src = address;
    },
    () => {},
  );
}

export function library({ main, store }) {
  const lists = Object.entries(PARTS).map(([kind, [title, empty]]) => {
    const list = h("div", { class: "cards" });
    const hint = h("p", { class: "quiet" }, empty);
    return { kind, list, hint, section: h("section", { "aria-label": title }, heading(2, title), hint, list) };
  });
  const first = h("p", { class: "first" }, "This library is empty. Drop photos into the field above: of one thing or place, taken from all sides. Then follow the buttons.");
  first.hidden = true;
  const foot = h("p", { class: "quiet" });
  const footer = h("footer", {}, foot, link("Trash", "#/trash"));
  main.append(
    heading(1, "Library"),
    intake(store),
    first,
    ...lists.map(({ section }) => section),
    footer,
  );
  const later = [...lists.map(({ section }) => section), footer];
  for (const part of later) part.hidden = true; // until it is known what is in them, so that nothing moves
  return {
    update() {
      const { library: all } = store;
      if (!all) return;
      for (const part of later) part.hidden = false;
      first.hidden = lists.some(({ kind }) => store.entries(kind).length);
      for (const { kind, list, hint } of lists) {
        hint.hidden = store.entries(kind).length > 0;
        const entries = [...store.entries(kind)].sort((a, b) => b.modified - a.modified);
        keyed(list, entries, ({ name }) => name, card, (element, entry) => {
          element.querySelector(".facts").textContent = factsOf(entry).filter(Boolean).join(" · ");
          const state = stateOf(store, entry);
          const place = element.querySelector(".states");
          if (place.dataset.state !== state) {
            place.dataset.state = state;
            place.replaceChildren(...(state ? [badge(state)] : []));
          }
          picture(element, entry);
        });
      }
      foot.textContent = `${all.folder} · ${bytes(all.used_bytes)} used, ${bytes(all.free_bytes)} free`;
    },
  };
}

function stateOf(store, entry) {
  const job = store.jobsOf(entry.entry)[0];
  if (job && (job.active || ["held", "failed", "interrupted"].includes(job.job.state))) return job.job.state;
  if (entry.problem) return "damaged";
  return "";
}

// Rename and remove, at the end of an entry's screen.
export function management(store, entry) {
  const line = errorLine();
  const name = h("input", { id: "rename", type: "text", value: entry.name, required: true, autocomplete: "off" });
  const rename = h("button", {}, "Rename");
  const away = button("Move to the trash", () =>
    attempt(away, line, async () => {
      await remove(at(entry.entry));
      announce(`Moved ${entry.name} to the trash`);
      await store.refresh();
      location.hash = "#/";
    }),
  );
  const form = h(
    "form",
    {
      class: "row",
      onsubmit: (event) => {
        event.preventDefault();
        attempt(rename, line, async () => {
          const made = await post(at(entry.entry, "rename"), { to: name.value });
          await store.refresh();
          location.hash = addressOf(made);
        });
      },
    },
    h("label", { for: "rename" }, "Name"),
    name,
    rename,
    away,
  );
  return h("details", {}, h("summary", {}, "Rename or remove"), h("p", { class: "quiet" }, entry.path), form, line);
}

// The top of an entry's screen.
export function entryHead(entry, kindTitle) {
  const facts = h("p", { class: "quiet facts" });
  const problem = errorLine();
  const element = h("div", { class: "head" }, h("p", { class: "kind" }, kindTitle), heading(1, entry.name), facts, problem);
  return {
    element,
    update(now) {
      if (!now) return;
      facts.textContent = factsOf(now).filter(Boolean).join(" · ");
      put(problem, now.problem ?? "");
    },
  };
}

// Waits for an entry of the library to be known, then shows its screen.
export function withEntry({ main, store, where }, show) {
  let inner = null;
  main.append(heading(1, where.name || "…"));
  return {
    follows: (place) => inner?.follows?.(place) ?? false,
    close: () => inner?.close?.(),
    update() {
      const entry = store.entry(where.kind, where.name);
      if (!inner && entry && store.read) {
        main.replaceChildren();
        inner = show(entry);
      } else if (!inner && store.library && store.read && !main.querySelector(".error")) {
        const missing = `${where.kind}/${where.name} is not in this library; it may have been renamed or removed.`;
        main.append(h("p", { class: "error" }, missing), link("Back to the library", "#/"));
      }
      inner?.update?.(entry ?? { ...inner.entry });
    },
  };
}

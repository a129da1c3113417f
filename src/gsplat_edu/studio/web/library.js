// The library: everything in the folder, with pictures and states.

import { at, get, post } from "./api.js";
import { attempt, bytes, button, count, errorLine, h, heading, link, patch, put, want, whole } from "./dom.js";
import { follow } from "./draft.js";
import { intake } from "./intake.js";
import { badge, leftOf } from "./jobs.js";
import { nextStep, timeline } from "./project.js";
import { discard } from "./undo.js";

const KINDS = { photos: "Photos", captures: "Capture", runs: "Run", scenes: "Scene" };

export const addressOf = ({ kind, name }) => `#/${kind}/${encodeURIComponent(name)}`;

// What an entry is, in a few words.
export function factsOf(entry) {
  const { kind } = entry;
  if (kind === "photos" || kind === "captures") {
    const videos = entry.videos ? count(entry.videos, "video") : "";
    const photos = entry.photos || !videos ? count(entry.photos, "photo") : "";
    if (entry.unfinished) return [bytes(entry.bytes)];
    return [
      photos,
      videos,
      kind === "captures" ? (entry.layout ?? "no poses found") : "",
      searchOf(entry),
      bytes(entry.bytes),
    ];
  }
  if (kind === "scenes") return [entry.file ? entry.file.split(".").at(-1) : "no scene file", bytes(entry.scene_bytes)];
  const done = entry.iterations ?? 0;
  return [
    entry.training
      ? "in training"
      : entry.finished
        ? `${whole(done)} iterations`
        : entry.planned
          ? `${whole(done)} of ${whole(entry.planned)} iterations`
          : "no iterations yet",
    entry.verdict?.grade ?? "",
    entry.num_gaussians ? `${whole(entry.num_gaussians)} splats` : "",
    entry.edited ? "edited" : "",
  ];
}

// What the search for a capture's poses found; empty if they come from another program.
export function searchOf({ search }) {
  if (!search) return "";
  const all =
    search.photos === null
      ? ""
      : `${whole(search.posed)} of ${count(search.photos, "photo")} ${search.photos === 1 ? "has" : "have"} a pose`;
  return [all, `mean error ${search.error.toFixed(2)} px`].filter(Boolean).join(", ");
}

// Address of a small picture of photos; null if there is none.
async function pictureOf(entry) {
  if (!entry.photos) return null;
  const { photos } = await get(at(entry.entry, "photos"));
  const good = photos.find(({ problem }) => !problem);
  return good ? `${at(entry.entry, "thumbs", good.name)}?side=256` : null;
}

// A project's card: its picture, timeline and next step, and a list of everything in it.
function card(store, project) {
  const image = h("img", { alt: "", loading: "lazy", hidden: true, onerror: () => (image.hidden = true) });
  const [name, facts, states] = [
    heading(2, "", { class: "name" }),
    h("span", { class: "facts quiet" }),
    h("span", { class: "states" }),
  ];
  const [bar, left] = [h("progress", { max: 1, value: 0 }), h("span", { class: "left quiet" })];
  const running = h("div", { class: "progress", hidden: true }, bar, left);
  const top = h(
    "a",
    { class: "card" },
    h("span", { class: "thumb", "aria-hidden": "true" }, image),
    name,
    facts,
    states,
  );
  top.image = image;
  const [stages, next] = [timeline(), nextStep(store, project.name)];
  const [summary, list] = [h("summary", {}), h("ul", { class: "plain" })];
  const element = h(
    "article",
    { class: "project card" },
    top,
    running,
    stages.element,
    next.element,
    h("details", {}, summary, list),
  );
  element.show = (now) => {
    const entries = now.entries.map((entry) => store.entry(...entry.split("/"))).filter(Boolean);
    const present = entries.filter(({ unfinished }) => !unfinished).at(-1) ?? entries[0];
    if (!present) return;
    element.setAttribute("aria-label", now.name);
    put(name, now.name);
    top.href = addressOf(present);
    facts.textContent = factsOf(present).filter(Boolean).join(" · ");
    const all = entries.map((entry) => stateOf(store, entry));
    patch(states, badges(all.findLast(Boolean)));
    const view = entries.flatMap((entry) => store.jobsOf(entry.entry)).find(({ job }) => job.state === "running");
    running.hidden = !view;
    if (view) {
      const { progress, stage, job } = view;
      bar.setAttribute("aria-label", `progress of ${job.title}`);
      if (progress?.total) [bar.max, bar.value] = [progress.total, progress.done];
      else bar.removeAttribute("value");
      left.textContent = `${stage || job.title}${progress?.total ? `: ${leftOf(progress, view.stages.length > 1)}` : ""}`;
    }
    stages.update(now);
    next.update(now, now.next);
    summary.textContent = `Everything in it (${entries.length})`;
    patch(
      list,
      entries.map((entry) =>
        want(
          "li",
          { "data-key": entry.entry },
          want("a", { href: addressOf(entry) }, `${KINDS[entry.kind]} ${entry.name}`),
          want("span", { class: "quiet" }, ` ${factsOf(entry).filter(Boolean).join(" · ")} `),
          want("span", {}, badges(stateOf(store, entry))),
        ),
      ),
    );
    const shown = entries.find(({ entry }) => entry === now.picture);
    if (shown) picture(top, shown);
    else image.hidden = true;
  };
  return element;
}

const badges = (state) => state && badge(state);

// The studio draws the pictures of scenes, one after the other, and only those that somebody sees.
let drawn = Promise.resolve();
const covers = new IntersectionObserver((seen) => {
  for (const { target, isIntersecting } of seen) {
    const { cover, image } = target;
    if (!isIntersecting || !cover) continue;
    target.cover = null;
    drawn = drawn.then(async () => {
      if (!target.isConnected || !(await fetch(cover).catch(() => ({}))).ok) return;
      Object.assign(image, { src: cover, hidden: false });
    });
  }
});

// Reads the picture again once the entry has changed.
function picture(element, entry) {
  const version = `${entry.entry} ${entry.modified} ${entry.files} ${entry.finished}`;
  if (element.version === version) return;
  element.version = version;
  if (entry.kind === "scenes" || entry.kind === "runs") {
    const isThere = entry.kind === "runs" ? entry.psnr !== null : entry.file;
    element.cover = isThere && `${at(entry.entry, "cover")}?of=${entry.modified}`;
    covers.unobserve(element);
    covers.observe(element); // tells at once if it is seen
    return;
  }
  pictureOf(entry).then(
    (address) => {
      element.image.hidden = !address;
      if (address) element.image.src = address;
    },
    () => {},
  );
}

export function library({ main, store }) {
  const list = h("div", { class: "projects" });
  const section = h("section", { "aria-label": "Projects" }, list);
  const line = errorLine();
  const example = button("Try the example", () =>
    attempt(example, line, async () => {
      const { entry } = await post("/api/example", {});
      await store.refresh();
      location.hash = `#/${entry.split("/").map(encodeURIComponent).join("/")}`;
    }),
  );
  const first = h(
    "div",
    { class: "first" },
    h(
      "p",
      {},
      "This library is empty. Drop photos into the field above: of one thing or place, taken from all sides. Then press Next.",
    ),
    h(
      "p",
      { class: "row" },
      example,
      h("span", { class: "quiet" }, "40 photos of a house in a garden, ready to train"),
    ),
    line,
  );
  first.hidden = true;
  const trash = link("Trash", "#/trash");
  const foot = h("p", { class: "quiet" });
  const footer = h("footer", {}, foot, trash);
  const add = intake(store);
  let cards = new Map();
  main.append(heading(1, "Library"), add, first, section, footer);
  for (const part of [section, footer]) part.hidden = true; // until it is known what is in them, so that nothing moves
  return {
    update() {
      const { library: all } = store;
      if (!all) return;
      const { projects } = all;
      footer.hidden = false;
      section.hidden = !projects.length;
      first.hidden = projects.length > 0;
      add.querySelector("[data-key-u]").classList.toggle("primary", !projects.length);
      cards = new Map(
        projects.map((project) => [project.entries[0], cards.get(project.entries[0]) ?? card(store, project)]),
      );
      patch(list, [...cards.values()]);
      for (const project of projects) cards.get(project.entries[0]).show(project);
      foot.textContent = `${all.folder} · ${bytes(all.used_bytes)} used, ${bytes(all.free_bytes)} free`;
      trash.textContent = all.trash_bytes ? `Trash (${bytes(all.trash_bytes)})` : "Trash";
    },
  };
}

function stateOf(store, entry) {
  const job = store.jobsOf(entry.entry)[0];
  if (job && (job.active || ["held", "failed", "interrupted"].includes(job.job.state))) return job.job.state;
  if (entry.problem) return "damaged";
  if (entry.unfinished) return "unfinished";
  return "";
}

// Rename and remove, at the end of an entry's screen.
export function management(store, entry) {
  const line = errorLine();
  const name = h("input", { id: "rename", type: "text", value: entry.name, required: true, autocomplete: "off" });
  const rename = h("button", {}, "Rename");
  const [all, said] = [h("input", { type: "checkbox", checked: true }), h("span", {})];
  const too = h("label", { class: "check", hidden: true }, all, said);
  const away = button("Move to the trash", () =>
    attempt(away, line, async () => {
      await discard(store, at(entry.entry), entry.name);
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
          const along = !too.hidden && all.checked;
          const made = await post(at(entry.entry, "rename"), along ? { to: name.value, along } : { to: name.value });
          for (const [old, now] of Object.entries(made.renamed ?? { [entry.entry]: made.entry })) follow(old, now);
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
  // what came from it keeps its link either way; the names only follow
  const tell = () => {
    const others = store.namedAfter(entry);
    too.hidden = !others.length;
    said.textContent = ` rename what came from it, too: ${others.map(({ kind, name: other }) => `${KINDS[kind].toLowerCase()} ${other}`).join(", ")}`;
  };
  const ontoggle = ({ target }) => target.open && tell();
  return h(
    "details",
    { ontoggle },
    h("summary", {}, "Rename or remove"),
    h("p", { class: "quiet" }, entry.path),
    form,
    too,
    line,
  );
}

// The top of an entry's screen.
export function entryHead(store, entry, kindTitle) {
  const [facts, problem] = [h("span", {}), errorLine()];
  const from = h("span", { class: "from", hidden: true }, " · Trained from the capture ", link("", "#/"));
  const line = h("p", { class: "quiet facts" }, facts, from);
  const [stages, next] = [timeline(), nextStep(store)];
  const element = h(
    "div",
    { class: "head" },
    h("p", { class: "kind" }, kindTitle),
    heading(1, entry.name),
    line,
    stages.element,
    next.element,
    problem,
  );
  return {
    element,
    // source: the entry that this one was made from, or null
    update(now, source = null) {
      if (!now) return;
      from.hidden = !source;
      if (source) Object.assign(from.lastChild, { href: addressOf(source), textContent: source.name });
      facts.textContent = factsOf(now).filter(Boolean).join(" · ");
      put(problem, now.problem ?? "");
      const project = store.projectOf(now.entry);
      stages.update(project);
      next.update(project, now.next ?? project?.next ?? null);
    },
  };
}

// Waits for an entry of the library to be known, then shows its screen. Only the studio says that an entry is missing:
// the list of this tab may be old.
export function withEntry({ main, store, where }, show) {
  let [inner, asked] = [null, false];
  const gone = errorLine();
  const path = `${where.kind}/${where.name}`;
  main.append(heading(1, where.name || "…"));

  async function ask() {
    asked = true;
    const error = h("p", { class: "error" });
    try {
      if (await store.find(where.kind, where.name)) return;
      error.textContent = `${path} is not in this library; it may have been renamed or removed.`;
    } catch ({ message }) {
      error.textContent = message;
    }
    if (!inner) main.append(error, link("Back to the library", "#/"));
  }

  return {
    follows: (place) => inner?.follows?.(place) ?? false,
    close: () => inner?.close?.(),
    update() {
      const entry = store.entry(where.kind, where.name);
      if (!inner && entry && store.read) {
        patch(main, gone);
        inner = show(entry);
      } else if (!inner && store.library && store.read && !asked) {
        ask();
      }
      put(gone, inner && !entry ? `${path} is not in this library any more; it was renamed or removed.` : "");
      inner?.update?.(entry ?? { ...inner.entry });
    },
  };
}

// Home: every project as a picture with its name, age and state, and how to begin one.

import { post } from "./api.js";
import { age, attempt, button, bytes, errorLine, h, heading, link, patch, put } from "./dom.js";
import { picture } from "./covers.js";
import { addressOf } from "./entries.js";
import { intake } from "./intake.js";
import { hashOf, nextStep, runningIn, stateLine } from "./project.js";
import { walks } from "./walks.js";

// A project's card: its picture, how far it is, and its next step.
function card(store, project) {
  const image = h("img", { alt: "", loading: "lazy", hidden: true, onerror: () => (image.hidden = true) });
  const [name, old, state] = [heading(2, "", { class: "name" }), h("span", { class: "small quiet" }), h("span", {})];
  const top = h(
    "a",
    { class: "card" },
    h("span", { class: "thumb", "aria-hidden": "true" }, image),
    name,
    h("span", { class: "states small" }, state, old),
  );
  top.image = image;
  const bar = h("progress", { max: 1, value: 0, hidden: true });
  const next = nextStep(store, project.name);
  const element = h("article", { class: "project card" }, top, bar, next.element);
  element.show = (now) => {
    const entries = now.entries.map((entry) => store.entry(...entry.split("/"))).filter(Boolean);
    const present = entries.filter(({ unfinished }) => !unfinished).at(-1) ?? entries[0];
    if (!present) return;
    element.setAttribute("aria-label", now.name);
    put(name, now.name);
    put(old, age(now.modified));
    put(state, stateLine(store, now, entries));
    top.href = addressOf(present);
    const view = runningIn(store, entries);
    bar.hidden = !view;
    if (view) {
      const { progress, job } = view;
      bar.setAttribute("aria-label", `progress of ${job.title}`);
      if (progress?.total) [bar.max, bar.value] = [progress.total, progress.done];
      else bar.removeAttribute("value");
    }
    next.update(now, now.next);
    const shown = entries.find(({ entry }) => entry === now.picture && !store.arriving.has(entry));
    if (shown) picture(top, shown);
    else image.hidden = true;
  };
  return element;
}

// The example's button, with what it is.
function example(store, line) {
  const load = button("Try the example", () =>
    attempt(load, line, async () => {
      const { entry } = await post("/api/example", {});
      await store.refresh();
      location.hash = hashOf(entry);
    }),
  );
  return h(
    "p",
    { class: "row" },
    load,
    h("span", { class: "quiet" }, "40 photos of a house in a garden, ready to train"),
  );
}

// What a person without projects sees.
function welcome(store, add, line) {
  const said = "Make a scene that you can look at from everywhere, from photos of a thing, a room or a house.";
  const element = h(
    "section",
    { class: "first", "aria-label": "First project", hidden: true },
    h("p", {}, said),
    add,
    walks(),
    example(store, line),
  );
  return element;
}

export function home({ main, store }) {
  const add = intake(store);
  const line = errorLine();
  const list = h("div", { class: "projects" });
  const section = h("section", { "aria-label": "Projects", hidden: true }, list);
  const dialog = h(
    "dialog",
    { class: "begin", "aria-labelledby": "begin-title" },
    heading(2, "New project", { id: "begin-title" }),
    h("form", { method: "dialog", class: "actions" }, h("button", {}, "Close")),
  );
  const begin = button("New", () => dialog.showModal(), { "aria-haspopup": "dialog", hidden: true });
  add.began = () => dialog.close();
  const first = welcome(store, add.element, line);
  const trash = link("Trash", "#/trash");
  const foot = h("p", { class: "quiet" });
  const footer = h("footer", { hidden: true }, foot, trash); // until it is known what is in it, so that nothing moves
  let cards = new Map();
  main.append(
    h("div", { class: "row title" }, heading(1, "Projects"), begin),
    line,
    add.progress,
    first,
    section,
    footer,
    dialog,
  );
  return {
    take: add.take,
    update() {
      const { library: all } = store;
      if (!all) return;
      const { projects } = all;
      footer.hidden = false;
      begin.hidden = section.hidden = !projects.length;
      first.hidden = projects.length > 0;
      if (first.hidden !== dialog.contains(add.element)) {
        if (first.hidden) dialog.lastChild.before(add.element);
        else first.firstChild.after(add.element);
      }
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

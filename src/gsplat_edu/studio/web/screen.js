// What the screens of a project share: its rail, the top, and renaming.

import { at, post } from "./api.js";
import { attempt, button, errorLine, h, heading, link, patch, put } from "./dom.js";
import { follow } from "./draft.js";
import { addressOf, factsOf, KINDS } from "./entries.js";
import { nextStep } from "./project.js";
import { everything, rail } from "./rail.js";
import { discard } from "./undo.js";

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
export function entryHead(store, entry) {
  const [facts, problem] = [h("span", {}), errorLine()];
  const from = h("span", { class: "from", hidden: true }, " · Trained from the photos of ", link("", "#/"));
  const line = h("p", { class: "quiet facts" }, facts, from);
  const next = nextStep(store);
  const element = h("div", { class: "head" }, heading(1, entry.name), line, next.element, problem);
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
      next.update(project, now.next ?? project?.next ?? null);
    },
  };
}

// Waits for an entry of the library to be known, then shows its screen: the rail, and beside it the stage, which
// show(entry, stage) fills. Only the studio says that an entry is missing: the list of this tab may be old.
export function withEntry({ main, store, where }, show) {
  let [inner, asked] = [null, false];
  const gone = errorLine();
  const path = `${where.kind}/${where.name}`;
  const stage = h("div", { class: "stage" });
  const [steps, all] = [rail(store), everything(store)];
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
    if (!inner) main.append(error, link("Back to the projects", "#/"));
  }

  return {
    follows: (place) => inner?.follows?.(place) ?? false,
    close: () => inner?.close?.(),
    get take() {
      return inner?.take;
    },
    update() {
      const entry = store.entry(where.kind, where.name);
      if (!inner && entry && store.read) {
        patch(main, gone, steps.element, h("div", { class: "beside-rail" }, stage, all.element));
        inner = show(entry, stage);
      } else if (!inner && store.library && store.read && !asked) {
        ask();
      }
      put(gone, inner && !entry ? `${path} is not in this library any more; it was renamed or removed.` : "");
      inner?.update?.(entry ?? { ...inner.entry });
      const project = inner && store.projectOf(`${where.kind}/${where.name}`);
      steps.update(project);
      all.update(project);
    },
  };
}

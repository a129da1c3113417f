// What was removed, until the trash is emptied.

import { at, get, post, remove } from "./api.js";
import { agreed, attempt, button, errorLine, h, heading, link, patch, versioned, want } from "./dom.js";

const said = (kind, name, entry) => {
  if (kind === "jobs") return `job ${name} of the list`;
  return entry ? `${name}, a file of ${entry}` : `${kind}/${name}`;
};

export function trash({ main, store }) {
  const line = errorLine();
  const list = h("ul", { class: "plain" });
  const empty = h("p", { hidden: true }, "The trash is empty.");
  const clear = button("Empty the trash", () =>
    attempt(clear, line, async () => {
      if (!(await agreed("Empty the trash?", "What is in it is deleted for good.", "Delete everything"))) return;
      await remove("/api/trash");
      await store.refresh();
    }),
  );

  function show({ trash: found }) {
    empty.hidden = found.length > 0;
    clear.hidden = !found.length;
    patch(
      list,
      found.map(({ id, kind, name, entry, removed }) => {
        const onclick = ({ currentTarget }) =>
          attempt(currentTarget, line, async () => {
            await post(at("trash", id, "restore"));
            await Promise.all([store.refresh(), kind === "jobs" && store.readJobs()]);
          });
        const when = new Date(1000 * removed).toLocaleString("en");
        return want(
          "li",
          { class: "row", "data-key": id },
          want("span", {}, said(kind, name, entry)),
          want("span", { class: "quiet" }, `removed ${when}`),
          want("button", { type: "button", onclick }, "Restore"),
        );
      }),
    );
  }

  main.append(
    heading(1, "Trash"),
    empty,
    list,
    h("p", { class: "row" }, clear),
    line,
    h("p", {}, link("Back to the projects", "#/")),
  );
  // Each answer about the library is a new object: it comes after every change, those of other screens and tabs too.
  const held = versioned(line, () => get("/api/trash"), show);
  return { update: () => held.read(store.library) };
}

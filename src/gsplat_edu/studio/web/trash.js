// What was removed, until the trash is emptied.

import { at, get, post, remove } from "./api.js";
import { agreed, attempt, button, errorLine, h, heading, link, patch, want } from "./dom.js";

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
      await read();
      store.refresh();
    }),
  );

  let questions = 0;
  async function read() {
    const asked = ++questions;
    const { trash: found } = await get("/api/trash");
    if (asked !== questions) return; // the answer is older than that to a later question
    empty.hidden = found.length > 0;
    clear.hidden = !found.length;
    patch(
      list,
      found.map(({ id, kind, name, entry, removed }) => {
        const onclick = ({ currentTarget }) =>
          attempt(currentTarget, line, async () => {
            await post(at("trash", id, "restore"));
            await read();
            store.refresh();
            if (kind === "jobs") await store.readJobs();
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
  attempt(null, line, read);
  return {};
}

// What was removed, until the trash is emptied.

import { at, get, post, remove } from "./api.js";
import { attempt, button, errorLine, h, heading, link, patch, want } from "./dom.js";

export function trash({ main, store }) {
  const line = errorLine();
  const list = h("ul", { class: "plain" });
  const empty = h("p", { hidden: true }, "The trash is empty.");
  const clear = button("Empty the trash", () =>
    attempt(clear, line, async () => {
      if (!confirm("Delete everything in the trash? This cannot be undone.")) return;
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
          });
        const when = new Date(1000 * removed).toLocaleString("en");
        return want(
          "li",
          { class: "row", "data-key": id },
          want("span", {}, entry ? `${name}, a file of ${entry}` : `${kind}/${name}`),
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

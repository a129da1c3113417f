// What was removed, until the trash is emptied.

import { at, get, post, remove } from "./api.js";
import { attempt, button, errorLine, h, heading, keyed, link } from "./dom.js";

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
    keyed(
      list,
      found,
      ({ id }) => id,
      ({ id, kind, name, removed }) => {
        const back = button("Restore", () =>
          attempt(back, line, async () => {
            await post(at("trash", id, "restore"));
            await read();
            store.refresh();
          }),
        );
        const when = new Date(1000 * removed).toLocaleString("en");
        return h(
          "li",
          { class: "row" },
          h("span", {}, `${kind}/${name}`),
          h("span", { class: "quiet" }, `removed ${when}`),
          back,
        );
      },
    );
  }

  main.append(heading(1, "Trash"), empty, list, clear, line, h("p", {}, link("Back to the library", "#/")));
  attempt(null, line, read);
  return {};
}

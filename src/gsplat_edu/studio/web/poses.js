// Whose poses a capture is read with, if its folder has those of several programs.

import { at, get, post } from "./api.js";
import { errorLine, h, patch, put, versioned, want } from "./dom.js";

// chosen() is called after another file was chosen.
export function poses(entry, chosen) {
  const line = errorLine();
  const select = h("select", { id: "poses", onchange: () => choose(select.value) });
  const element = h(
    "div",
    { hidden: true },
    h("label", { class: "row" }, "Cameras from ", select),
    h("p", { class: "quiet" }, "Several programs left cameras here. A training uses those that you choose."),
    line,
  );

  async function choose(file) {
    select.disabled = true;
    put(line, "");
    try {
      await post(at(entry.entry, "poses"), { file });
      chosen();
    } catch (error) {
      put(line, error.message);
    }
    select.disabled = false;
  }

  const found = versioned(
    line,
    () => get(at(entry.entry, "poses")),
    ({ files, chosen: file, lost }) => {
      element.hidden = !files.length;
      const usual = want("option", { value: "" }, "the file that train reads by itself");
      const options = files.map(({ file: value, program }) => {
        const same = files.filter((other) => other.program === program).map((other) => other.file);
        const which = same.length > 1 ? ` (${same.indexOf(value) + 1} of ${same.length})` : "";
        return want("option", { value, title: value }, `${program}${which}`);
      });
      patch(select, [usual, ...options]);
      select.value = file ?? "";
      if (lost) select.selectedIndex = -1;
      put(line, lost ? "The cameras that were chosen are gone. Choose others." : "");
    },
  );
  return { element, read: (now) => found.read(now.modified) };
}

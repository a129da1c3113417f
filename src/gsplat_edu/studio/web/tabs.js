// The screens of runs and scenes: a row of tabs, each of which shows one part.

import { h, link } from "./dom.js";
import { edit } from "./edit.js";
import { compare, judge } from "./judge.js";
import { entryHead, management, withEntry } from "./library.js";
import { share } from "./share.js";
import { look, watch } from "./watch.js";

const RUN = { "": ["Watch", watch], judge: ["Judge", judge], edit: ["Edit", edit], share: ["Share", share] };
const SCENE = { "": ["View", look], edit: ["Edit", edit], share: ["Share", share] };

export const run = (given) => tabbed(given, "Run", RUN);
export const scene = (given) => tabbed(given, "Scene", SCENE);

function tabbed(given, title, tabs) {
  const { store, main } = given;
  return withEntry(given, (entry) => {
    const head = entryHead(entry, title);
    const base = `#/${entry.kind}/${encodeURIComponent(entry.name)}`;
    const links = new Map(
      Object.entries(tabs).map(([tab, [text]]) => [tab, link(text, tab ? `${base}/${tab}` : base)]),
    );
    const place = h("div", { class: "tab" });
    main.append(head.element, h("nav", { class: "tabs", "aria-label": `parts of ${entry.name}` }, [...links.values()]), place);
    const manage = management(store, entry);
    main.append(manage);
    let [part, now] = [null, entry];

    function open(where) {
      part?.close?.();
      const tab = tabs[where.tab] || where.tab === "compare" ? where.tab : "";
      for (const [name, element] of links) {
        const current = name === (tab === "compare" ? "judge" : tab);
        if (current) element.setAttribute("aria-current", "page");
        else element.removeAttribute("aria-current");
      }
      place.replaceChildren();
      part = (tab === "compare" ? compare : tabs[tab][1])({ place, store, entry, where });
      part.tab = tab;
      part.update?.(now);
    }

    open(given.where);
    return {
      entry,
      follows(where) {
        if (where.kind !== entry.kind || where.name !== entry.name) return false;
        if (!(part.tab === where.tab && part.follows?.(where))) open(where);
        return true;
      },
      close: () => part.close?.(),
      update(found) {
        if (found.path) now = found;
        head.update(now);
        part.update?.(now);
      },
    };
  });
}

// The screens of runs and scenes: a row of tabs, each of which shows one part.

import { h, link, patch } from "./dom.js";
import { hasDraft } from "./draft.js";
import { edit } from "./edit.js";
import { compare, judge } from "./judge.js";
import { entryHead, management, withEntry } from "./screen.js";
import { share } from "./share.js";
import { undoBegun } from "./undo.js";
import { look, watch } from "./watch.js";

const RUN = { "": ["Watch", watch], judge: ["Judge", judge], edit: ["Edit", edit], share: ["Share", share] };
const SCENE = { "": ["View", look], edit: ["Edit", edit], share: ["Share", share] };

export const run = (given) => tabbed(given, RUN);
export const scene = (given) => tabbed(given, SCENE);

function tabbed(given, tabs) {
  const { store } = given;
  return withEntry(given, (entry, stage) => {
    const head = entryHead(store, entry);
    const base = `#/${entry.kind}/${encodeURIComponent(entry.name)}`;
    const links = new Map(
      Object.entries(tabs).map(([tab, [text]]) => [tab, link(text, tab ? `${base}/${tab}` : base)]),
    );
    const place = h("div", { class: "tab" });
    const begun = undoBegun(store, entry);
    stage.append(
      head.element,
      begun.element,
      h("nav", { class: "tabs", "aria-label": `parts of ${entry.name}` }, [...links.values()]),
      place,
    );
    const manage = management(store, entry);
    stage.append(manage);
    let [part, now] = [null, entry];

    const top = () => {
      const training = Boolean(store.jobsOf(entry.entry, "train")[0]?.active); // its screen counts the iterations once
      head.update({ ...now, training }, store.captureOf(now));
    };

    const mark = () => {
      const unsaved = hasDraft(entry.entry);
      const shown = links.get("edit");
      shown.textContent = unsaved ? "Edit •" : "Edit"; // a phone has no room for the word
      if (unsaved) shown.setAttribute("aria-label", "Edit (unsaved)");
      else shown.removeAttribute("aria-label");
    };

    function open(where) {
      part?.close?.();
      const tab = tabs[where.tab] || where.tab === "compare" ? where.tab : "";
      for (const [name, element] of links) {
        const current = name === (tab === "compare" ? "judge" : tab);
        if (current) element.setAttribute("aria-current", "page");
        else element.removeAttribute("aria-current");
      }
      patch(place);
      part = (tab === "compare" ? compare : tabs[tab][1])({ place, store, entry, where });
      part.tab = tab;
      mark();
      part.update?.(now);
    }

    begun.update();
    open(given.where);
    return {
      entry,
      follows(where) {
        if (where.kind !== entry.kind || where.name !== entry.name) return false;
        if (!(part.tab === where.tab && part.follows?.(where))) open(where);
        top(); // another tab has another next step
        return true;
      },
      close: () => part.close?.(),
      update(found) {
        if (found.path) now = found;
        begun.update();
        mark();
        part.update?.(now);
        top();
      },
    };
  });
}

// The rail of a project's screens: five steps with their state, and the list of everything in the project.

import { addressOf, factsOf, KINDS, stateOf } from "./entries.js";
import { h, icon, patch, want } from "./dom.js";
import { badge } from "./jobs.js";
import { hashOf, STAGES, stepLine } from "./project.js";

const ICONS = { photos: "photos", poses: "camera", training: "training", look: "scene", share: "share" };

// The step that the page shows; the one that the project has reached, if it shows none of them.
function shownStage(store, project) {
  const [kind, name, tab] = location.hash.replace(/^#\/?/, "").split("?")[0].split("/").map(decodeURIComponent);
  if (tab === "share") return "share";
  const isDone = kind === "scenes" || store.entry(kind, name)?.verdict;
  const stage = { photos: "photos", captures: "poses", runs: isDone ? "look" : "training", scenes: "look" }[kind];
  return project.steps.some((step) => step.stage === stage && step.place) ? stage : project.stage;
}

// The steps in order, each a link to what there is of it.
export function rail(store) {
  const list = h("ol", { class: "timeline" });
  const element = h("nav", { class: "rail", "aria-label": "steps of the project", hidden: true }, list);
  return {
    element,
    update(project) {
      element.hidden = !project;
      if (!project) return;
      const present = project.steps.findIndex(({ stage }) => stage === project.stage);
      const shown = shownStage(store, project);
      patch(
        list,
        project.steps.map(({ stage, place }, index) => {
          const isDone = index < present && place;
          const is = {
            class: isDone ? "done" : index === present ? "present" : null,
            "aria-current": stage === shown ? "step" : null,
          };
          const title = want("span", { class: "step" }, STAGES[stage]);
          const said = want("span", { class: "small quiet" }, stepLine(store, project, stage));
          const inner = [want("span", { class: "mark" }, icon(isDone ? "done" : ICONS[stage])), title, said];
          return want("li", is, place ? want("a", { href: hashOf(place) }, ...inner) : want("div", {}, ...inner));
        }),
      );
    },
  };
}

// Photos, captures, runs and scenes of a project, under one line.
export function everything(store) {
  const [summary, list] = [h("summary", {}), h("ul", { class: "plain" })];
  const element = h("details", { class: "everything", hidden: true }, summary, list);
  return {
    element,
    update(project) {
      const entries = (project?.entries ?? []).map((entry) => store.entry(...entry.split("/"))).filter(Boolean);
      element.hidden = !entries.length;
      summary.textContent = `Everything in it (${entries.length})`;
      patch(
        list,
        entries.map((entry) => {
          const state = stateOf(store, entry);
          return want(
            "li",
            { "data-key": entry.entry, class: "row" },
            want("a", { href: addressOf(entry) }, `${KINDS[entry.kind]} ${entry.name}`),
            want("span", { class: "quiet" }, factsOf(entry).filter(Boolean).join(" · ")),
            state && badge(state),
          );
        }),
      );
    },
  };
}

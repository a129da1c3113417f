// A project: its timeline, and the one next step.

import { at } from "./api.js";
import { attempt, errorLine, h, patch, put, want } from "./dom.js";
import { startJob } from "./jobs.js";

const STAGES = { photos: "Photos", poses: "Poses", training: "Training", look: "Look and edit", share: "Share" };
const STEPS = new Set(["sfm", "train", "convert", "render"]); // commands of jobs that lead to the next stage

// The address of a place such as "runs/toy/share".
export const hashOf = (place) => `#/${place.split("/").map(encodeURIComponent).join("/")}`;

// The stages in order, each a link to what there is of it.
export function timeline() {
  const element = h("ol", { class: "timeline", "aria-label": "stages of the project" });
  return {
    element,
    update(project) {
      element.hidden = !project;
      if (!project) return;
      const present = project.steps.findIndex(({ stage }) => stage === project.stage);
      patch(
        element,
        project.steps.map(({ stage, place }, index) => {
          const title = STAGES[stage];
          const more = {
            class: index < present && place ? "done" : null,
            "aria-current": index === present ? "step" : null,
          };
          return want("li", more, place ? want("a", { href: hashOf(place) }, title) : want("span", {}, title));
        }),
      );
    },
  };
}

// Whether the page shows a place: an entry on any of its tabs, or the tab for sharing.
function isShown(place) {
  const [kind, name, tab] = location.hash.replace(/^#\/?/, "").split("?")[0].split("/");
  const [ownKind, ownName, ownTab] = hashOf(place).slice(2).split("/");
  return kind === ownKind && name === ownName && (tab === "share") === (ownTab === "share");
}

// The step to offer on this screen: the one after the last step that leads here, if one does.
function onward(step) {
  let found = step;
  for (let at = step; at; at = at.then) if (at.place && isShown(at.place)) found = at.then ?? null;
  return found ?? null;
}

// The button for the next step. On the library's cards, `of` names the project; on an entry's screen, a form that asks
// for the same job is sent with what is chosen there.
export function nextStep(store, of = "") {
  const line = errorLine();
  const place = h("div", { class: "row" });
  const note = want("span", { class: "quiet" }, "The next step comes when the job has ended.");
  const element = h("div", { class: "next-step" }, place, line);
  let shown = "";

  const ask = (request, pressed) =>
    attempt(pressed, line, async () => {
      const { job } = await startJob(store, request);
      await store.refresh();
      location.hash = hashOf(request.command === "convert" ? `${job.subject}/share` : job.subject);
    });

  function made({ label, place: to, request, entry, file }, form) {
    const text = `Next: ${label}`;
    const more = { class: "button primary", "aria-label": of ? `${text}, ${of}` : null };
    if (to) return want("a", { ...more, href: hashOf(to) }, text);
    if (file) return want("a", { ...more, href: at(entry, "exports", file), download: file }, text);
    if (form) return want("button", { ...more, type: "submit", form: form.id }, text);
    const onclick = ({ currentTarget: pressed }) => ask(request, pressed);
    return want("button", { ...more, type: "button", onclick }, text);
  }

  return {
    element,
    update(project, step) {
      const active = [...store.jobs.values()].some(
        ({ active: runs, job: { work } }) =>
          runs && STEPS.has(work.command) && project?.entries.includes(work.inputs[0]),
      );
      let found = of ? step : onward(step);
      if (found?.request && active) found = null; // the list of the library is older than the job
      const screen = of ? null : element.closest("main");
      const waits = [...(screen?.querySelectorAll(".job [data-key-p].primary") ?? [])].some((one) =>
        one.checkVisibility(),
      );
      if (waits) found = null; // a job that stopped has a button of its own
      const asks = found?.request && `${found.request.command} ${found.request.subject}`;
      const forms = [...(screen?.querySelectorAll("form[data-next]") ?? [])];
      const form = forms.find(({ dataset }) => dataset.next === asks);
      for (const one of forms) {
        const own = one.querySelector("[data-own]");
        if (own) own.hidden = one === form;
      }
      const text = JSON.stringify([found, Boolean(form), active]);
      if (shown === text) return;
      shown = text;
      put(line, "");
      patch(place, found ? made(found, form) : active && !of && note);
    },
  };
}

// A project: its timeline, and the one next step.

import { at, get } from "./api.js";
import { announce, attempt, button, errorLine, forecastText, h, link, put } from "./dom.js";
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
      const text = JSON.stringify(project && [project.stage, project.steps]);
      if (!project || element.dataset.text === text) return;
      element.dataset.text = text;
      const present = project.steps.findIndex(({ stage }) => stage === project.stage);
      element.replaceChildren(
        ...project.steps.map(({ stage, place }, index) => {
          const title = STAGES[stage];
          const more = {
            class: index < present && place ? "done" : null,
            "aria-current": index === present ? "step" : null,
          };
          return h("li", more, place ? link(title, hashOf(place)) : h("span", {}, title));
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
  const note = h("span", { class: "quiet" }, "The next step comes when the job has ended.");
  const takes = h("p", { class: "forecast quiet", hidden: true });
  const element = h("div", { class: "next-step" }, place, takes, line);
  let shown = "";

  const ask = (request, pressed) =>
    attempt(pressed, line, async () => {
      const { job } = await startJob(store, request);
      await store.refresh();
      location.hash = hashOf(request.command === "convert" ? `${job.subject}/share` : job.subject);
    });

  // A training that is started from a card says first what it takes; the same button then starts it.
  async function tellFirst(request, pressed, more) {
    pressed.disabled = true;
    put(takes, "Measuring time and memory ...");
    put(line, "");
    try {
      const { qualities } = await get(at(request.subject, "forecast"));
      put(takes, `It takes ${forecastText(qualities[request.options.quality])}.`);
      announce(takes.textContent);
    } catch (error) {
      put(takes, "There is no forecast.");
      put(line, error.message);
    }
    const begin = h(
      "button",
      { ...more, "aria-label": `Next: Start it, ${of}`, type: "button", onclick: () => ask(request, begin) },
      "Next: Start it",
    );
    const later = button("Not now", () => {
      put(takes, "");
      put(line, "");
      pressed.disabled = false;
      place.replaceChildren(pressed);
      pressed.focus();
    });
    if (pressed.isConnected) {
      place.replaceChildren(begin, later);
      begin.focus();
    }
  }

  function made({ label, place: to, request, entry, file }, form) {
    const text = `Next: ${label}`;
    const more = { class: "button primary", "aria-label": of ? `${text}, ${of}` : null };
    if (to) return link(text, hashOf(to), more);
    if (file) return link(text, at(entry, "exports", file), { ...more, download: file });
    if (form) return h("button", { ...more, type: "submit", form: form.id }, text);
    const isToTell = of && request.command === "train" && request.options?.quality;
    const act = () => (isToTell ? tellFirst(request, pressed, more) : ask(request, pressed));
    const pressed = h("button", { ...more, type: "button", onclick: act }, text);
    return pressed;
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
      put(takes, "");
      place.replaceChildren(...(found ? [made(found, form)] : active && !of ? [note] : []));
    },
  };
}

// A project: how far it is, and the one next step.

import { at } from "./api.js";
import { attempt, count, errorLine, h, patch, put, want } from "./dom.js";
import { startJob, timeLeft } from "./jobs.js";

export const STAGES = { photos: "Photos", poses: "Cameras", training: "Training", look: "Scene", share: "Share" };
const STEPS = new Set(["sfm", "train", "convert", "render"]); // commands of jobs that lead to the next stage

// The address of a place such as "runs/toy/share".
export const hashOf = (place) => `#/${place.split("/").map(encodeURIComponent).join("/")}`;

// What a job does, in a card's words.
const DOING = {
  sfm: "Finding the cameras",
  train: "Training",
  convert: "Exporting",
  render: "Making a video",
  clean: "Cleaning",
  mesh: "Making a mesh",
  doctor: "Examining the photos",
};

// The job that runs for one of some entries; undefined if there is none.
export const runningIn = (store, entries) =>
  entries.flatMap(({ entry }) => store.jobsOf(entry)).find(({ job }) => job.state === "running");

const doing = (view) => DOING[view.job.work.command] ?? view.job.title;

// "Training, 4 min left".
function workLine(view) {
  const { progress, stages } = view;
  const left = progress?.total ? timeLeft(progress, stages.length > 1) : "";
  return [doing(view), left].filter(Boolean).join(", ");
}

const ENDS = {
  queued: "waits for its turn",
  paused: "is paused",
  held: "waits for you",
  failed: "failed",
  interrupted: "was interrupted",
};

// How far a project is, in one line.
export function stateLine(store, project, entries) {
  const running = runningIn(store, entries);
  if (running) return workLine(running);
  const last = entries.map(({ entry }) => store.jobsOf(entry)[0]).findLast((view) => view && ENDS[view.job.state]);
  if (last) return `${doing(last)} ${ENDS[last.job.state]}`;
  if (entries.some(({ problem }) => problem)) return "Damaged";
  const stages = Object.keys(STAGES);
  for (const stage of stages.slice(1, stages.indexOf(project.stage) + 1).reverse()) {
    const line = stepLine(store, project, stage);
    if (line) return `${STAGES[stage]}: ${line.toLowerCase()}`;
  }
  return stepLine(store, project, "photos");
}

// What there is of one step of a project, in two or three words; empty if there is nothing.
export function stepLine(store, project, stage) {
  const entries = project.entries.map((entry) => store.entry(...entry.split("/"))).filter(Boolean);
  const running = runningIn(store, entries);
  const isAt = running && (RUNS_AT[running.job.work.command] ?? "") === stage;
  if (isAt) return "Working on it"; // the job's card has the one clock of a screen
  const of = (...kinds) => entries.filter(({ kind }) => kinds.includes(kind));
  const result = of("runs").findLast(({ verdict }) => verdict) ?? null;
  const lines = {
    photos: () => photosLine(of("photos", "captures")[0]),
    poses: () => camerasLine(of("captures").findLast(({ unfinished }) => !unfinished)),
    training: () => (of("runs").some(({ finished }) => finished) ? "Done" : of("runs").length ? "Not finished" : ""),
    look: () => result?.verdict.grade ?? (of("scenes").length ? "Ready" : ""),
    share: () => (project.stage === "share" ? "File made" : ""),
  };
  return lines[stage]();
}

const RUNS_AT = { sfm: "poses", train: "training", clean: "look", convert: "share", render: "share", mesh: "share" };

function photosLine(entry) {
  if (!entry) return "";
  const some = [entry.photos && count(entry.photos, "photo"), entry.videos && count(entry.videos, "video")];
  return some.filter(Boolean).join(", ") || "No photos yet";
}

function camerasLine(capture) {
  if (!capture?.layout) return "";
  const { search } = capture;
  return search?.photos ? `${search.posed} of ${search.photos} placed` : "Placed";
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

// The button for the next step, and how long it takes if that is known. On the cards of home, `of` names the project; on an entry's screen, a form that asks
// for the same job is sent with what is chosen there.
export function nextStep(store, of = "") {
  const line = errorLine();
  const place = h("div", { class: "row" });
  const note = want("span", { class: "quiet" }, "The next step comes when this one has ended.");
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
      const takes = form?.dataset.takes ?? ""; // how long it takes with what is chosen there
      const text = JSON.stringify([found, Boolean(form), active, takes]);
      if (shown === text) return;
      shown = text;
      put(line, "");
      const time = takes && want("span", { class: "quiet" }, takes);
      patch(place, found ? [made(found, form), time] : active && !of && note);
    },
  };
}

// Jobs: how far each one is, its buttons, and the command that repeats it.

import { at, get, post } from "./api.js";
import { attempt, button, commandLine, duration, errorLine, h, heading, link, patch, put, toned, want } from "./dom.js";
import { discard } from "./undo.js";

const STATES = {
  held: "waits for you",
  queued: "waiting",
  running: "running",
  paused: "paused",
  done: "done",
  failed: "failed",
  cancelled: "stopped",
  interrupted: "interrupted",
  unfinished: "not placed yet",
};

const REMOVE = "Remove from the list";

// For patch().
export const badge = (state) => toned(state, STATES[state] ?? state);

// Starts a job; its answer is in the store when this returns.
export async function startJob(store, request) {
  const heard = new Map(store.heard); // of a removed job, whose id a new one may get, it is not empty
  const job = await post("/api/jobs", request);
  return store.answered(job, heard.get(job.id));
}

// A card of one job. `update()` shows its present state.
export function jobCard(store, id, { main = false, level = 3 } = {}) {
  const line = errorLine();
  const state = h("span", { class: "state" });
  const stages = h("ol", { class: "stages", "aria-label": "stages" });
  const bar = h("progress", { max: "1", value: "0" });
  const left = h("span", { class: "left" });
  const said = h("p", { class: "said quiet" });
  const change = (action) => (event) =>
    attempt(event.currentTarget, line, async () => {
      const heard = store.heard.get(id);
      store.answered(await post(at("jobs", id, action)), heard);
    });
  const pause = button("Pause", change("pause"));
  const resume = button("Resume", change("resume"), { class: "primary" });
  const stop = button("Stop", change("cancel"), { title: "A training writes a checkpoint and can be resumed." });
  const forget = button(REMOVE, (event) =>
    attempt(event.currentTarget, line, () => discard(store, at("jobs", id), `“${store.jobs.get(id).job.title}”`)),
  );
  if (main) {
    pause.dataset.keyP = "";
    resume.dataset.keyP = "";
  }
  const output = h("pre", { tabindex: "0", role: "region", "aria-label": "output" });
  const view = store.jobs.get(id);
  const label = h("p", { class: "label" });
  const command = h("div", {});
  const more = h(
    "details",
    {
      ontoggle: async () => {
        if (more.open)
          output.textContent = (await get(at("jobs", id, "output")).catch((error) => error.message)) || "nothing yet";
      },
    },
    h("summary", {}, "Details"),
    label,
    command,
    output,
  );
  more.open = view.job.state === "held"; // what somebody starts is in sight
  const waits = h("p", { class: "waits quiet" });
  const ask = h(
    "p",
    {},
    "An earlier start of the studio left this job waiting. It runs this command once you start it:",
  );
  const element = h(
    "article",
    { class: "job card", "aria-label": view.job.title },
    h("div", { class: "row" }, heading(level, view.job.title), state),
    stages,
    h("div", { class: "progress" }, bar, left),
    said,
    waits,
    line,
    ask,
    h("div", { class: "row" }, pause, resume, stop, forget),
    more,
  );

  function update() {
    const found = store.jobs.get(id);
    if (!found) return;
    const { job, progress } = found;
    patch(state, badge(job.cancelling ? "stopping" : job.state));
    const current = found.stage;
    const ended = job.state === "done";
    const step = (name) => (name === current && !ended ? "step" : null);
    patch(
      stages,
      found.stages.map((name) =>
        // files without their folders
        want("li", { "data-key": name, title: name, "aria-current": step(name) }, name.replace(/^(\S+) .*\//, "$1 ")),
      ),
    );
    const known = progress?.total && !ended;
    bar.setAttribute("aria-label", `progress of ${current || job.title}`);
    if (known || !found.active) [bar.max, bar.value] = known ? [progress.total, progress.done] : [1, ended ? 1 : 0];
    else if (job.state === "running") bar.removeAttribute("value");
    else bar.value = 0;
    bar.parentElement.hidden = !found.active && !ended; // how far the last stage was says nothing of a job that failed
    left.textContent = known && found.active ? leftOf(progress, found.stages.length > 1) : "";
    said.textContent = job.state === "paused" ? "Paused. Resume continues it." : "";
    said.hidden = !said.textContent;
    waits.textContent = job.state === "queued" ? waitingFor(store, job.waits_for) : "";
    waits.hidden = !waits.textContent;
    line.classList.toggle("error", job.state !== "cancelled"); // stopping is no error
    if (job.line) put(line, job.plain ?? job.line);
    pause.hidden = job.state !== "running" || job.cancelling;
    resume.hidden = !(job.state === "paused" || (job.resumable && !found.active));
    resume.textContent = { failed: "Try again", held: "Start" }[job.state] ?? "Resume";
    ask.hidden = job.state !== "held";
    patch(command, commandLine(job.command));
    label.textContent = job.state === "held" ? "What it will run" : "The same as a command";
    stop.hidden = !found.active || job.cancelling;
    forget.hidden = found.active && job.state !== "queued";
  }

  update();
  return { element, update, id };
}

// What a job in the queue waits for, in one sentence. Its card is updated with each state of a job.
function waitingFor(store, others) {
  const titles = others.map(({ job }) => `“${store.jobs.get(job)?.job.title ?? `job ${job}`}”`);
  const places = [...new Set(others.map(({ place }) => place))];
  const [have, use] = others.length > 1 ? ["have", "they use"] : ["has", "it uses"];
  if (others.length) return `Waits until ${titles.join(" and ")} ${have} ended: ${use} ${places.join(" and ")} too.`;
  const running = [...store.jobs.values()].filter(
    ({ job }) => job.state === "running" || job.state === "paused",
  ).length;
  return running ? `Waits for its turn: ${running === 1 ? "1 job is" : `${running} jobs are`} running.` : "";
}

// Progress is that of the present stage.
export function leftOf(progress, isStage) {
  const share = `${Math.floor((100 * progress.done) / progress.total)} %`;
  return [share, timeLeft(progress, isStage)].filter(Boolean).join(", ");
}

// "4 min left"; empty if there is no forecast.
export function timeLeft({ seconds_left: left, is_least: isLeast }, isStage) {
  if (left === null || left === undefined) return "";
  return `${isLeast ? "at least " : ""}${duration(left)} left${isStage ? " in this step" : ""}`;
}

// Why there is no picture of a training yet.
export function waitsFor(view) {
  if (view?.job.state === "queued") return "This training waits for other jobs.";
  const { progress, stage } = view ?? {};
  const share = progress?.total ? `, ${Math.floor((100 * progress.done) / progress.total)} %` : "";
  return stage ? `The picture comes with the training. First: ${stage}${share}.` : "The training is starting.";
}

// The newest job about an entry; the card is replaced when another job begins.
export function jobPlace(store, subject, commands, options = {}) {
  const element = h("div", { class: "job-place" });
  let card = null;
  return {
    element,
    get view() {
      return store.jobsOf(subject, ...commands)[0] ?? null;
    },
    update() {
      const newest = store.jobsOf(subject, ...commands)[0] ?? null;
      if ((newest?.job.id ?? null) !== (card?.id ?? null)) {
        card = newest && jobCard(store, newest.job.id, options);
        patch(element, card?.element);
      }
      card?.update();
    },
  };
}

// The screen with all jobs.
export function jobs({ main, store }) {
  let cards = new Map();
  const fault = errorLine();
  const list = h("div", { class: "cards wide" });
  const broken = h("ul", { class: "damaged", "aria-label": "damaged jobs" });
  const empty = h("p", {}, "No jobs yet. They begin in your ", link("projects", "#/"), ".");
  main.append(heading(1, "Jobs"), broken, fault, empty, list);
  return {
    update() {
      const all = [...store.jobs.values()].sort((a, b) => b.job.id.localeCompare(a.job.id));
      empty.hidden = all.length + store.damaged.size > 0;
      patch(
        broken,
        [...store.damaged.values()].map(({ id, line }) => {
          const onclick = ({ currentTarget }) =>
            attempt(currentTarget, fault, () => discard(store, at("jobs", id), `job ${id}`));
          return want("li", { "data-key": id }, line, " ", want("button", { type: "button", onclick }, REMOVE));
        }),
      );
      cards = new Map(all.map(({ job: { id } }) => [id, cards.get(id) ?? jobCard(store, id, { level: 2 })]));
      patch(
        list,
        all.map(({ job: { id, subject } }) => {
          const href = `#/${subject.split("/").map(encodeURIComponent).join("/")}`;
          return want("div", { "data-key": id }, want("a", { href }, subject), cards.get(id).element);
        }),
      );
      for (const card of cards.values()) card.update();
    },
  };
}

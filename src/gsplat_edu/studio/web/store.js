// What the studio knows: the library, and jobs with their events as they happen.

import { at, get, startsBy } from "./api.js";

export const ACTIVE = new Set(["queued", "running", "paused"]);

const RECONNECT = 2000; // milliseconds, after the stream was closed for good
const CLEARLY = 1.1; // times the time left that is shown; a forecast beyond it makes that a least time
const TOGETHER = 300; // milliseconds in which changes of the library are read once

// A job and what its events say.
class JobView {
  constructor(job) {
    this.job = job;
    this.clear();
  }

  clear() {
    Object.assign(this, { last: 0, stages: [], progress: null, least: null, messages: [], metrics: new Map() });
  }

  take(event) {
    if (event.number <= this.last) return;
    this.last = event.number;
    if (event.event === "started") Object.assign(this, { stages: [], progress: null, least: null });
    if (event.event === "stage" && !this.stages.includes(event.name)) this.stages.push(event.name);
    if (event.event === "stage") this.progress = null;
    if (event.event === "progress") this.progress = { ...event, ...this.leftOf(event) };
    if (event.event === "message") this.messages = [...this.messages.slice(-199), event.text];
    if (event.event === "metric") this.metrics.set(`${event.name} ${event.of}`, event);
  }

  // The time left of a stage never rises: what was said before stays until the forecast has come down to it. Meanwhile
  // it is a least time, if the forecast is clearly larger.
  leftOf({ stage, seconds_left: left }) {
    if (this.least?.stage !== stage) this.least = { stage, left: Infinity };
    const known = left ?? Infinity;
    const isLeast = known > CLEARLY * this.least.left;
    this.least.left = Math.min(this.least.left, known);
    return { seconds_left: Number.isFinite(this.least.left) ? this.least.left : null, is_least: isLeast };
  }

  get active() {
    return ACTIVE.has(this.job.state);
  }

  get stage() {
    return this.progress?.stage ?? this.stages.at(-1) ?? "";
  }
}

// What is known of a run that has no folder yet.
function runOf({ subject, created }) {
  const nothing = {
    planned: null,
    iterations: null,
    psnr: null,
    ssim: null,
    num_gaussians: null,
    seconds: null,
    verdict: null,
  };
  const entry = { kind: "runs", name: subject.slice(5), entry: subject, path: "", adopted: null, modified: created };
  return { ...entry, ...nothing, files: 0, bytes: 0, finished: false, capture: null, problem: null, edited: false };
}

export class Store extends EventTarget {
  constructor() {
    super();
    Object.assign(this, {
      library: null,
      arriving: new Set(), // entries that this tab uploads, whose kind the studio has yet to decide
      jobs: new Map(),
      damaged: new Map(),
      heard: new Map(),
      connected: null,
      trouble: "",
      read: false,
    });
    Object.assign(this, { questions: 0, latest: 0 }); // about the library: how many, and which one was answered last
  }

  // "change": something is different; detail.job is the id of a job, if it is one.
  changed(job = null) {
    this.dispatchEvent(new CustomEvent("change", { detail: { job } }));
  }

  entry(kind, name) {
    return this.entries(kind).find((entry) => entry.name === name) ?? null;
  }

  // Entries of a kind. A run whose training has not yet made its folder is there too.
  entries(kind) {
    const found = this.library?.[kind] ?? [];
    if (kind !== "runs" || !this.library) return found;
    const names = new Set(found.map(({ entry }) => entry));
    const coming = [...this.jobs.values()].filter(({ job, active }) => {
      return (
        job.subject.startsWith("runs/") &&
        job.work.command === "train" &&
        !names.has(job.subject) &&
        (active || job.line || job.state === "held")
      );
    });
    return [...found, ...new Map(coming.map(({ job }) => [job.subject, runOf(job)])).values()];
  }

  // The entry that a finished job has made; null if there is none.
  madeBy(view) {
    const [kind, name] = (view?.job.state === "done" && view.job.work.outputs[0]?.split("/")) || [];
    return (kind && this.entry(kind, name)) || null;
  }

  // The project that an entry belongs to; null until the library's list has it.
  projectOf(entry) {
    return this.library?.projects.find(({ entries }) => entries.includes(entry)) ?? null;
  }

  // The entry that a path lies in.
  entryAt(path) {
    for (const kind of ["photos", "captures", "runs", "scenes"]) {
      const found = this.library?.[kind].find((entry) => {
        return [entry.path, entry.adopted].some((own) => own && (path === own || path.startsWith(`${own}/`)));
      });
      if (found) return found;
    }
    return null;
  }

  // The capture of a run: what the studio says it was made from, under its present name.
  captureOf(run) {
    const from = run.made_from ?? this.jobsOf(run.entry, "train")[0]?.job.work.inputs[0]; // its folder may come later
    const [kind, name] = from?.split("/") ?? [];
    if (kind === "captures") return this.entry(kind, name);
    return run.capture ? this.entryAt(run.capture) : null;
  }

  // What was made from an entry and is named after it.
  namedAfter({ entry, name }) {
    const all = ["captures", "runs", "scenes"].flatMap((kind) => this.library?.[kind] ?? []);
    const isFrom = (one, depth = 0) => {
      if (!one?.made_from || depth > 9) return false;
      return (
        one.made_from === entry ||
        isFrom(
          all.find((other) => other.entry === one.made_from),
          depth + 1,
        )
      );
    };
    return all.filter((one) => isFrom(one) && (one.name === name || one.name.startsWith(`${name}-`)));
  }

  // Jobs about an entry, newest first.
  jobsOf(entry, ...commands) {
    const all = [...this.jobs.values()].filter(({ job }) => job.subject === entry);
    const found = all.filter(({ job }) => !commands.length || commands.includes(job.work.command));
    return found.sort((a, b) => b.job.id.localeCompare(a.job.id));
  }

  // Reads the library. An answer that comes after that to a later question is older, and dropped.
  async refresh() {
    const question = ++this.questions;
    const [library, trouble] = await get("/api/library").then(
      (found) => [found, found.trouble.join(" ")],
      (error) => [null, error.message],
    );
    if (question < this.latest) return;
    this.latest = question;
    if (library) {
      this.library = library;
      startsBy(library.start);
    }
    this.trouble = trouble;
    this.changed();
  }

  // Asks the studio for an entry that the list lacks; the list may be old. Returns whether the studio has it.
  async find(kind, name) {
    const found = await get(at(kind, name)).catch((error) => {
      if (error.status !== 404) throw error;
      return null;
    });
    if (found && !this.entry(kind, found.name)) this.library[kind].push(found);
    this.changed();
    return Boolean(found);
  }

  refreshSoon() {
    this.timer ||= setTimeout(() => {
      this.timer = 0;
      this.refresh();
    }, TOGETHER);
  }

  // Takes a job from an answer. The stream may already have brought a newer state: `heard` is how often it had spoken of
  // this job when the answer was asked for.
  answered(job, heard) {
    if (this.heard.get(job.id) === heard) this.put(job);
    return this.jobs.get(job.id);
  }

  put(job) {
    const known = this.jobs.get(job.id);
    const before = known?.job.state;
    if (known) known.job = job;
    else this.jobs.set(job.id, new JobView(job));
    if (before !== job.state && (before !== undefined || this.read)) this.refreshSoon();
    this.changed(job.id);
    return this.jobs.get(job.id);
  }

  // Reads the events of a job that the stream has not brought.
  async catchUp(id) {
    const view = this.jobs.get(id);
    if (!view) return;
    const { events } = await get(`${at("jobs", id, "events")}?after=${view.last}`);
    for (const event of events) view.take(event);
    this.changed(id);
  }

  async readJobs() {
    const heard = new Map(this.heard);
    const { jobs: found, damaged } = await get("/api/jobs");
    const isNews = ({ id }) => this.heard.get(id) === heard.get(id); // else the stream has told what came later
    this.damaged = new Map(damaged.map((found) => [found.id, found]));
    const ids = new Set(found.map(({ id }) => id));
    for (const id of this.jobs.keys()) if (!ids.has(id) && isNews({ id })) this.jobs.delete(id);
    for (const job of found.filter(isNews)) {
      if (this.jobs.has(job.id)) this.jobs.get(job.id).job = job;
      else this.jobs.set(job.id, new JobView(job));
    }
    this.read = true;
    await Promise.all(found.slice(-20).map(({ id }) => this.catchUp(id)));
    this.changed();
  }

  // Follows the jobs. The browser reconnects by itself after a break and sends the id of the last event that it has.
  connect() {
    const source = new EventSource("/api/events");
    source.addEventListener("open", () => this.setConnected(true));
    source.addEventListener("error", () => {
      this.setConnected(false);
      if (source.readyState !== EventSource.CLOSED) return;
      setTimeout(() => this.refresh().then(() => this.connect()), RECONNECT);
    });
    source.addEventListener("reset", () => {
      this.readJobs().catch(() => {});
      this.refreshSoon();
    });
    source.addEventListener("job", ({ data }) => {
      const job = JSON.parse(data);
      this.hears(job.id);
      this.put(job);
    });
    source.addEventListener("event", ({ data }) => {
      const event = JSON.parse(data);
      const view = this.jobs.get(event.job);
      if (!view) return;
      if (event.number > view.last + 1) this.catchUp(event.job).catch(() => {});
      else view.take(event);
      if (event.event === "stage") this.refreshSoon(); // a stage makes files
      this.changed(event.job);
    });
    source.addEventListener("library", () => this.refreshSoon());
    source.addEventListener("removed", ({ data }) => {
      const { id } = JSON.parse(data);
      this.hears(id);
      this.jobs.delete(id);
      if (this.damaged.delete(id)) this.refreshSoon(); // its line is in the library's list of troubles
      this.changed();
    });
    source.addEventListener("full", () => {
      this.trouble = "Too many pages of this studio are open; close one, then reload this one.";
      source.close();
      this.changed();
    });
  }

  hears(id) {
    this.heard.set(id, (this.heard.get(id) ?? 0) + 1);
  }

  setConnected(connected) {
    if (this.connected === false && connected) this.refreshSoon();
    this.connected = connected;
    this.changed();
  }
}

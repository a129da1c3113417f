// The page: it shows what the worker says, and tells it what people want. The worker computes.

import { filesOf } from "../../viewer/web/dropped.js";
import { h, keepPresses, patch, want } from "../../viewer/web/patch.js";
import { bytes, count, duration, whole } from "../../viewer/web/words.js";

const EXAMPLE = { url: "example.zip", name: "Garden" };
const LENGTHS = { draft: "Draft", standard: "Standard", high: "High" };
const SIZES = { 480: "480 px", 800: "800 px", 1200: "1200 px" };
const PHONE = { most: 40_000, longest: 480, quality: "draft" };
const DESKTOP = { most: null, longest: 800, quality: "standard" };
const HELD_OUT = "This photo is not used for the training: it shows whether new views are right.";

const start = matchMedia("(max-width: 600px), (pointer: coarse)").matches ? PHONE : DESKTOP;

// What is shown: one of the stages "intake", "reading", "trial", "ready", "running", "paused", "comparing" and "ended".
const state = { stage: "intake", asked: { ...start }, error: "", notes: [], found: null };

const canvases = { photo: h("canvas", { "aria-label": "photo" }), render: h("canvas", { "aria-label": "render" }) };
const worker = new Worker(new URL("./worker.js", import.meta.url), { type: "module" });

const tell = (message) => worker.postMessage(message);

const icon = (name) =>
  want("svg", { class: "icon", "aria-hidden": "true" }, want("use", { href: `base/web/icons.svg#icon-${name}` }));

const button = (text, onclick, more = {}, ...inside) =>
  want("button", { type: "button", onclick, ...more }, ...inside, text);

function change(values) {
  Object.assign(state, values);
  show();
}

// Says something to screen readers, once.
function announce(text) {
  const status = document.getElementById("status");
  if (status.textContent !== text) status.textContent = text;
}

// Reads files, and prepares the training of what they are.
function open(files, name) {
  if (!files.length) return;
  change({ stage: "reading", error: "", notes: [], name, reading: null, forecast: null });
  tell({ do: "open", files, name });
}

function openFolder({ target }) {
  const files = [...target.files].map((file) => ({ file, path: file.webkitRelativePath || file.name }));
  open(files, files[0]?.path.split("/")[0]);
  target.value = "";
}

function openZip({ target }) {
  const [file] = target.files;
  if (file) open([{ file, path: file.name }], stem(file.name));
  target.value = "";
}

const stem = (name) => name.replace(/\.[^.]+$/, "");

async function openExample() {
  change({ stage: "reading", error: "", reading: null, name: EXAMPLE.name });
  try {
    const answer = await fetch(EXAMPLE.url);
    if (!answer.ok) throw new Error(answer.statusText);
    open([{ file: await answer.blob(), path: "example.zip" }], EXAMPLE.name);
  } catch {
    change({ stage: "intake", error: "The example did not load: is the program that serves this page still running?" });
  }
}

async function drop(event) {
  event.preventDefault();
  document.body.classList.remove("over");
  if (!["intake", "ready", "ended"].includes(state.stage)) return;
  const files = await filesOf(event.dataTransfer);
  const [top] = files[0]?.path.split("/") ?? [""];
  open(files, stem(top));
}

function prepare(asked) {
  Object.assign(state.asked, asked);
  change({ stage: "reading", reading: null, forecast: null, verdict: null, error: "" });
  tell({ do: "prepare", ...state.asked });
}

function begin() {
  change({ stage: "running" });
  tell({ do: "start" });
}

function pause() {
  change({ stage: "paused" });
  tell({ do: "pause" });
}

function leave() {
  tell({ do: "close" });
  change({ stage: "intake", asked: { ...start }, found: null, verdict: null, error: "", notes: [] });
}

// What the worker says, by its first word.
const heard = {
  done: ({ did }) => did === "open" && state.stage === "reading" && prepare({}),
  found: (found) => state.stage === "intake" && change({ found }),
  reading: ({ done, total }) => change({ reading: { done, total } }),
  note: ({ text }) => change({ notes: [...state.notes, text] }),
  comparing: ({ done, total }) => change({ stage: "comparing", compared: { done, total } }),

  opened(facts) {
    const { quality, longest } = facts;
    change({ stage: state.stage === "resuming" ? "running" : "trial", facts, notes: facts.notes, name: facts.name });
    Object.assign(state.asked, { quality, longest });
  },

  forecast(forecast) {
    change({ forecast, stage: state.stage === "trial" ? "ready" : state.stage });
    if (state.stage === "ready") announce("The training is ready to start.");
  },

  progress: (progress) => change({ progress }),

  picture({ W, H, image, photo, name, at }) {
    draw(canvases.render, image, W, H);
    if (photo) draw(canvases.photo, photo, W, H);
    change({ picture: { name, at } });
  },

  verdict(verdict) {
    change({ stage: "ended", verdict });
    announce(verdict.sentence);
  },

  ply({ name, file }) {
    const url = URL.createObjectURL(file);
    const link = h("a", { href: url, download: `${name}.ply` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(url), 60_000);
  },

  error({ did, text }) {
    const isRunning = ["start", "resume", "show", "ply", "keep", "pause"].includes(did);
    change({ error: text, stage: isRunning && state.facts ? "paused" : "intake" });
  },
};

function draw(canvas, pixels, W, H) {
  Object.assign(canvas, { width: W, height: H });
  canvas.getContext("2d").putImageData(new ImageData(pixels, W, H), 0, 0);
}

// A native file field inside a button's look.
const chooser = (text, onchange, more) =>
  want("label", { class: "button wide" }, want("input", { type: "file", class: "aside", onchange, ...more }), text);

function intake() {
  return [
    state.found && continued(state.found),
    want(
      "section",
      { class: "empty", "aria-label": "Capture" },
      icon("photos"),
      want("h2", {}, "Drop a folder or zip file of photos with camera poses"),
      want("p", { class: "quiet" }, "As COLMAP, nerfstudio and gsplat-edu sfm write them."),
      want(
        "div",
        { class: "row" },
        chooser("Choose a folder", openFolder, { webkitdirectory: true, multiple: true }),
        chooser("Choose a zip file", openZip, { accept: ".zip,application/zip" }),
        button("Try the example", openExample, { class: "primary wide" }),
      ),
      want("p", { class: "small quiet" }, "The example has 40 photos of a house in a garden."),
    ),
  ];
}

function continued({ name, iteration, iterations }) {
  const resume = () => {
    change({ stage: "resuming", error: "", found: null });
    tell({ do: "resume" });
  };
  const share = Math.floor((100 * iteration) / iterations);
  const forget = () => {
    tell({ do: "close" });
    change({ found: null });
  };
  return want(
    "section",
    { class: "card", "aria-label": "Kept training" },
    want("h2", {}, `Continue ${name}`),
    want("p", {}, `Its training was kept when this page was closed, at ${share} %.`),
    want("div", { class: "row" }, button("Continue", resume, { class: "primary" }), button("Discard", forget)),
  );
}

function reading() {
  const { reading: at, name } = state;
  const [done, total] = at ? [at.done, at.total] : [0, 0];
  const text = at ? `Preparing photo ${Math.min(done + 1, total)} of ${total}` : "Reading the poses";
  return want(
    "section",
    { "aria-label": "Reading" },
    want("h2", {}, name),
    bar(text, total ? done / total : null),
    want("div", { class: "row" }, button("Cancel", leave, { class: "wide" })),
  );
}

// A bar with what it waits for; without a value, it is unknown how far it is.
const bar = (text, value, left = "") =>
  want(
    "div",
    {},
    want("p", { class: "row heading" }, want("span", {}, text), want("span", { class: "quiet number" }, left)),
    want("progress", { max: 1, value, "aria-label": text }),
  );

function pictures() {
  const { facts, picture } = state;
  const at = picture?.at ?? 0;
  const show = (next) => () => tell({ do: "show", at: (next + facts.compared) % facts.compared });
  const held = facts.heldOut ? HELD_OUT : "";
  const arrows = [
    [-1, "previous", "Previous photo"],
    [1, "next", "Next photo"],
  ].map(([step, name, label]) =>
    button("", show(at + step), { class: "icon-button", "aria-label": label, title: label }, icon(name)),
  );
  return want(
    "section",
    { "aria-label": "Pictures" },
    want(
      "div",
      { class: "pictures" },
      want("figure", {}, canvases.photo, want("figcaption", { class: "small" }, "Photo")),
      want("figure", {}, canvases.render, want("figcaption", { class: "small" }, "The scene from the same place")),
    ),
    want(
      "p",
      { class: "row small" },
      facts.compared > 1 && arrows,
      want("span", { class: "quiet" }, picture ? `${picture.name.split("/").at(-1)}. ${held}` : ""),
    ),
  );
}

// Buttons of which one is pressed. names: {value: text}.
function segments(title, names, chosen, choose) {
  const one = ([value, text]) =>
    want(
      "label",
      {},
      want("input", {
        type: "radio",
        name: title,
        value,
        checked: String(chosen) === value,
        onchange: () => choose(value),
      }),
      text,
    );
  return want(
    "fieldset",
    {},
    want("legend", {}, title),
    want("div", { class: "segments" }, Object.entries(names).map(one)),
  );
}

function choices() {
  const { quality, longest } = state.asked;
  return want(
    "div",
    { class: "row choices" },
    segments("Length", LENGTHS, quality, (value) => prepare({ quality: value })),
    segments("Photo size", SIZES, longest, (value) => prepare({ longest: Number(value) })),
  );
}

function forecastText() {
  const { forecast } = state;
  if (!forecast) return bar("Trying the first steps", null);
  return want("p", {}, `About ${duration(forecast.seconds)}, and ${bytes(forecast.bytes)} of memory.`);
}

const ready = () => [
  choices(),
  forecastText(),
  want("div", { class: "row" }, button("Start", begin, { class: "primary wide", disabled: !state.forecast })),
];

function running() {
  const { progress, facts, stage, compared } = state;
  if (stage === "comparing") return [bar("Comparing with the photos", compared.done / compared.total)];
  const isPaused = stage === "paused";
  const left = progress && `${duration(progress.left)} left`;
  return [
    bar(isPaused ? "Paused" : "Training", progress ? progress.iteration / facts.iterations : 0, left),
    want(
      "div",
      { class: "row" },
      isPaused ? button("Continue", begin, { class: "primary wide" }) : button("Pause", pause, { class: "wide" }),
      isPaused && button("Download the scene so far", () => tell({ do: "ply" }), { class: "wide" }),
    ),
  ];
}

function ended() {
  const { verdict } = state;
  return [
    want("p", { class: `banner ${verdict.grade.toLowerCase()}`, role: "status" }, verdict.sentence),
    want(
      "div",
      { class: "row" },
      button("Download the scene (PLY)", () => tell({ do: "ply" }), { class: "primary wide" }, icon("down")),
      button("New scene", leave, { class: "wide" }),
    ),
  ];
}

function details() {
  const { facts, progress, verdict, forecast } = state;
  const rows = [
    ["Photos", `${facts.training} for training, ${facts.heldOut} held out, ${facts.W} x ${facts.H} px`],
    ["Threads", facts.threads],
    ["Start points", facts.measured ? "of the capture" : "random, where photos overlap"],
    progress && ["Iteration", `${whole(progress.iteration)} of ${whole(facts.iterations)}`],
    progress && [
      "Size",
      `${count(progress.count, "splat")}${forecast ? ` of up to ${whole(forecast.gaussians)}` : ""}`,
    ],
    progress?.loss && ["Loss", progress.loss.toFixed(4)],
    verdict && ["PSNR", figures(verdict)],
    verdict?.ssim && ["SSIM", verdict.ssim.toFixed(3)],
  ];
  const line = ([name, value]) => want("tr", {}, want("th", { scope: "row" }, name), want("td", {}, value));
  return want(
    "details",
    {},
    want("summary", {}, "Details"),
    want("table", {}, want("tbody", {}, rows.filter(Boolean).map(line))),
  );
}

function figures({ test, train }) {
  const trained = `${train.toFixed(2)} dB on training photos`;
  return test === null ? trained : `${test.toFixed(2)} dB on held-out photos, ${trained}`;
}

function content() {
  const { stage, facts, error, notes, name } = state;
  const failure = error && want("p", { class: "error", role: "alert" }, error);
  if (stage === "intake") return [failure, intake()];
  if (stage === "reading") return reading();
  if (stage === "resuming") return want("section", {}, bar("Opening the kept training", null));
  const isReady = ["trial", "ready"].includes(stage);
  return [
    failure,
    want(
      "div",
      { class: "row heading" },
      want("h2", {}, name),
      stage !== "ended" && button("Close", leave, { class: "quiet" }),
    ),
    notes.map((note) => want("p", { class: "notice" }, note)),
    pictures(),
    want("section", { "aria-label": "Training" }, isReady ? ready() : stage === "ended" ? ended() : running()),
    facts && details(),
  ];
}

function show() {
  patch(document.getElementById("place"), content());
  document.title =
    state.stage === "running" && state.progress ? `${percent()} % - ${state.name}` : "Train a scene in this tab";
}

const percent = () => Math.floor((100 * state.progress.iteration) / state.facts.iterations);

worker.addEventListener("message", ({ data }) => heard[data.say](data));
worker.addEventListener("error", ({ message }) => {
  change({ stage: "intake", error: `The training could not start in this browser: ${message ?? "it is too old"}.` });
});
addEventListener("dragover", (event) => {
  event.preventDefault();
  document.body.classList.add("over");
});
addEventListener("dragleave", ({ relatedTarget }) => relatedTarget || document.body.classList.remove("over"));
addEventListener("drop", drop);
document.addEventListener("visibilitychange", () => document.hidden && tell({ do: "keep" }));
keepPresses();
tell({ do: "find" });
show();

// The training, in a worker: it owns the module and the trainer, and answers the page. Each message to it is
// {do, ...}, a method of `acts`; each one from it is {say, ...}.

import { readCapture } from "./capture.js";
import { EngineError, loadModule, plannedGaussians, Trainer } from "./engine.js";
import { bytesNeeded, plannedIterations, secondsLeft } from "./length.js";
import { decodedView } from "./photos.js";
import { plyOf } from "./ply.js";
import { randomPoints } from "./points.js";
import { CaptureError } from "./reading.js";
import { forget, keepCapture, keepState, keptTraining } from "./store.js";
import { judged } from "./verdict.js";
import { isZip, unzipped } from "./zip.js";

const LIMIT = 2 ** 31; // bytes of the module's memory
const MOST_THREADS = 8;
const THREADS = crossOriginIsolated ? Math.min(navigator.hardwareConcurrency || 1, MOST_THREADS) : 1; // else memory is not shared
const FILE = THREADS > 1 ? "./gsplat_edu_threads.wasm" : "./gsplat_edu.wasm";
const TRIAL = 20; // steps before the forecast
const CHUNK = 0.2; // seconds of steps between two looks at the messages
const MOST_STEPS = 50;
const PICTURE = 2; // seconds between two pictures
const PICTURE_SHARE = 0.1; // of the time that pictures may take
const KEEP = 15; // seconds between two states that are kept
const MOST_SCORED = 16; // training photos that are compared with renders in the end

const say = (message, transfer = []) => postMessage(message, transfer);

const seconds = () => performance.now() / 1000;

// Lets waiting messages in.
const pause = () => new Promise((resolve) => setTimeout(resolve));

let dropped = null; // {name, capture}: what was read last, for other sizes and lengths
let training = null;
let request = 0; // number of the newest message that asks for another training
let isKeeping = false; // whether this tab keeps its training; of several tabs only the first does

// What an older request ends with once a newer one replaces it.
class Replaced extends Error {}

// One training: its views and settings, and the trainer.
class Training {
  constructor(module, given, state = null) {
    Object.assign(this, { given, run: 0, perStep: 0, shown: 0, kept: 0, drawn: 0, drawing: 0 });
    const { views, points, colors, settings } = given;
    this.training = views.filter(({ part }) => part === "train");
    this.heldOut = views.filter(({ part }) => part === "test");
    this.compared = this.heldOut.length ? this.heldOut : this.training;
    const options = { points, colors, views: this.training, settings };
    this.trainer = state ? Trainer.resumed(module, options, state) : new Trainer(module, options);
  }

  get steps() {
    return this.given.settings.iterations - this.trainer.iteration;
  }

  // Takes at most `count` steps, and measures how long one takes.
  step(count) {
    const steps = Math.min(count, this.steps);
    const began = seconds();
    this.last = this.trainer.step(steps);
    const perStep = (seconds() - began) / steps;
    this.perStep = this.perStep ? 0.8 * this.perStep + 0.2 * perStep : perStep;
  }

  get left() {
    const { count, planned } = this.trainer;
    const { iterations } = this.given.settings;
    return secondsLeft({ steps: this.steps, iterations, perStep: this.perStep, count, planned });
  }

  get facts() {
    const { name, notes, quality, longest, measured, settings } = this.given;
    const [{ camera }] = this.training;
    const counts = { training: this.training.length, heldOut: this.heldOut.length, compared: this.compared.length };
    return {
      name,
      notes,
      quality,
      longest,
      measured,
      threads: THREADS,
      ...counts,
      W: camera.W,
      H: camera.H,
      iterations: settings.iterations,
    };
  }

  progress() {
    const { iteration, count } = this.trainer;
    say({ say: "progress", iteration, count, loss: this.last?.loss, left: this.left });
  }

  // Draws the chosen photo's view, and with `whole` the photo, too.
  picture(whole = false) {
    const began = seconds();
    const { name, camera, pixels } = this.compared[this.shown];
    const image = opaque(this.trainer.render(camera).image, 255);
    const photo = whole ? opaque(pixels, 1) : null;
    const { W, H } = camera;
    say(
      { say: "picture", at: this.shown, name, W, H, image, photo },
      [image, photo].filter(Boolean).map(({ buffer }) => buffer),
    );
    this.drawing = seconds() - began;
    this.drawn = seconds();
  }

  // Steps until the end, or until another run or `stop` takes over.
  async train() {
    this.run += 1;
    const mine = this.run;
    while (this.run === mine && this.steps > 0) {
      this.step(Math.max(1, Math.min(MOST_STEPS, Math.round(CHUNK / this.perStep))));
      this.progress();
      if (seconds() - this.drawn > Math.max(PICTURE, this.drawing / PICTURE_SHARE)) this.picture();
      if (seconds() - this.kept > KEEP) await this.keep();
      await pause();
    }
    if (this.run === mine) await this.end();
  }

  stop() {
    this.run += 1;
  }

  async keep() {
    if (!isKeeping) return;
    this.kept = seconds();
    await kept(() => keepState({ iteration: this.trainer.iteration, bytes: this.trainer.state() }));
  }

  // Compares photos with renders, and says the verdict.
  async end() {
    await this.keep();
    if (training !== this) return;
    this.picture(true);
    const every = Math.ceil(this.training.length / MOST_SCORED);
    const trained = this.training.filter((_, i) => i % every === 0);
    const scores = [];
    for (const view of [...this.heldOut, ...trained]) {
      if (training !== this) return;
      scores.push({ name: view.name, ...this.trainer.score(view) });
      say({ say: "comparing", done: scores.length, total: this.heldOut.length + trained.length });
      await pause();
    }
    const test = scores.slice(0, this.heldOut.length);
    const [worst] = test.toSorted((one, other) => one.psnr - other.psnr);
    const figures = { test: mean(test, "psnr"), train: mean(scores.slice(test.length), "psnr") };
    const photos = this.training.length + this.heldOut.length;
    const verdict = judged({ ...figures, photos, worst: test.length > 1 ? worst.name : null });
    say({ say: "verdict", ...verdict, ...figures, ssim: mean(test, "ssim"), scores: test, count: this.trainer.count });
  }

  free() {
    this.stop();
    this.trainer.free();
  }
}

const mean = (scores, key) =>
  scores.length ? scores.reduce((sum, score) => sum + score[key], 0) / scores.length : null;

// RGB as RGBA bytes. full: what a byte of the result is multiplied by.
function opaque(rgb, full) {
  const out = new Uint8ClampedArray((rgb.length / 3) * 4).fill(255);
  for (let i = 0, k = 0; i < rgb.length; i += 3, k += 4) {
    for (let c = 0; c < 3; ++c) out[k + c] = full * rgb[i + c];
  }
  return out;
}

// Writes into the browser's storage. If it has no room, the training goes on and the page says so.
async function kept(act) {
  try {
    await act();
  } catch {
    isKeeping = false;
    say({ say: "note", text: "This browser has no room to keep the training, so it ends with this tab." });
  }
}

// Decodes the photos of a capture.
async function viewsOf(frames, longest) {
  const mine = request;
  const used = frames.filter(({ part }) => part !== "left out");
  const views = [];
  for (const frame of used) {
    say({ say: "reading", done: views.length, total: used.length });
    views.push(await decodedView(frame, longest));
    if (request !== mine) throw new Replaced();
  }
  return views;
}

// Ends the training and releases its memory.
function release() {
  training?.free();
  training = null;
}

function load() {
  const loading = loadModule(new URL(FILE, import.meta.url), { threads: THREADS, limit: LIMIT });
  loading.catch(() => {}); // `begin` says so
  return loading;
}

let module = load();

// Takes a new module in place of one that has refused something, whose memory is in no defined state.
async function replaceModule() {
  training = null;
  const old = await module.catch(() => null);
  old?.close();
  module = load();
}

// Makes the trainer, tries some steps and says how long all of them take.
async function begin(given, state = null) {
  const loaded = await module;
  release();
  training = new Training(loaded, given, state);
  const mine = training;
  say({ say: "opened", ...mine.facts });
  mine.picture(true);
  for (let i = 0; i < TRIAL && mine.steps > 1; ++i) {
    mine.step(1);
    await pause();
    if (training !== mine) throw new Replaced();
  }
  const { planned } = mine.trainer;
  say({ say: "forecast", seconds: mine.left, bytes: bytesNeeded(given.views, planned), gaussians: planned });
  mine.progress();
  mine.picture();
}

const acts = {
  // Looks for a training that was kept when the tab was closed.
  async find() {
    isKeeping = await firstTab();
    const found = isKeeping ? await keptTraining().catch(() => null) : null;
    if (!found) return;
    const { name, settings } = found.capture;
    say({ say: "found", name, iteration: found.state.iteration, iterations: settings.iterations });
  },

  async open({ files, name }) {
    request += 1;
    const mine = request;
    const single = files.length === 1 && (await isZip(files[0].file));
    const capture = await readCapture(single ? await unzipped(files[0].file) : files);
    if (request !== mine) throw new Replaced();
    dropped = { name, capture };
  },

  // Prepares what was opened for a length and a size of photos. most: limit of the Gaussians, or null.
  async prepare({ quality, longest, most }) {
    request += 1;
    const { name, capture } = dropped;
    release();
    const views = await viewsOf(capture.frames, longest);
    const trained = views.filter(({ part }) => part === "train");
    const measured = Boolean(capture.cloud?.points.length);
    const { points, colors } = measured ? capture.cloud : randomPoints(trained.map(({ camera }) => camera));
    const iterations = plannedIterations(quality, trained.length, measured);
    const pixels = trained.reduce((sum, { camera: { W, H } }) => sum + W * H, 0) / trained.length;
    const isLimited = most !== null && plannedGaussians(pixels, trained.length) > most;
    const settings = { iterations, seed: 0, ...(isLimited && { maxGaussians: most }) };
    await begin({ name, views, points, colors, settings, quality, longest, measured, notes: capture.notes });
  },

  async start() {
    const mine = training;
    if (isKeeping && !mine.kept) {
      await kept(() => keepCapture(mine.given));
      await mine.keep();
    }
    await mine.train();
  },

  pause() {
    training.stop();
    return training.keep();
  },

  keep: () => training?.kept && training.keep(),

  async resume() {
    request += 1;
    const { capture, state } = await keptTraining();
    await begin(capture, state.bytes);
    training.kept = seconds();
    await training.train();
  },

  show({ at }) {
    training.shown = at;
    training.picture(true);
  },

  ply() {
    say({ say: "ply", name: training.given.name, file: new Blob(plyOf(training.trainer.gaussians())) });
  },

  async close() {
    request += 1;
    release();
    if (isKeeping) await forget();
  },
};

// Whether no other tab keeps a training; holds that right until this worker ends.
function firstTab() {
  if (!navigator.locks) return true;
  return new Promise((resolve) => {
    navigator.locks.request("gsplat_edu training", { ifAvailable: true }, (lock) => {
      resolve(Boolean(lock));
      return lock ? new Promise(() => {}) : undefined;
    });
  });
}

addEventListener("message", async ({ data }) => {
  try {
    await acts[data.do](data);
    say({ say: "done", did: data.do });
  } catch (error) {
    if (error instanceof Replaced) return;
    const isKnown = error instanceof CaptureError;
    if (!isKnown) console.error(error);
    if (error instanceof EngineError || error instanceof WebAssembly.RuntimeError) await replaceModule();
    say({ say: "error", did: data.do, text: isKnown ? error.message : `This did not work: ${error.message}.` });
  }
});

// The page: unpacks the scene, then draws whenever something changes.
"use strict";

const SMOOTHING = 0.1; // weight of the newest frame in the frame rate
const REST = 400; // milliseconds without a frame after which the view counts as still
const LONGEST_STEP = 0.1; // most seconds of movement per frame for a held key, however long the frame took

class Viewer {
  constructor(facts, splats, levels = null) {
    this.facts = facts;
    this.levels = levels; // of detail
    this.settings = { ...facts.settings };
    this.canvas = element("canvas");
    this.renderer = this.makeRenderer(splats);
    this.sorter = new Sorter(splats.means, facts.near, (order) => this.renderer.setOrder(order));
    const eyes = facts.cameras.filter(({ saved }) => !saved).map(({ eye }) => eye);
    this.view = new View(facts.start, eyes);
    this.cameraIndex = facts.start.index;
    this.exact = null; // the camera given to setCamera, until the user moves
    this.lost = false;
    this.frameAsked = 0;
    this.lastFrame = 0; // 0 while the view is still
    this.smoothed = 0; // seconds per frame
    const actions = this.actions();
    this.panel = new Panel(facts, actions);
    this.keyframes = new Keyframes(facts, actions);
    this.journey = null; // the curve and the time it began, while the camera path is played
    this.controls = new Controls(this.canvas, this.view, actions);
    this.panel.mark(this.cameraIndex);
    this.levels?.attach(this.renderer, this.sorter);
    addEventListener("resize", () => this.askFrame());
    this.canvas.addEventListener("webglcontextlost", () => this.lose());
    this.askFrame();
  }

  makeRenderer(splats) {
    return new Renderer(this.canvas, splats, this.facts);
  }

  actions() {
    return {
      moved: () => this.moved(-1),
      awake: () => this.askFrame(),
      shown: () => this.camera(),
      orbitAround: (x, y) => this.orbitAround(x, y),
      help: () => this.panel.help(),
      fly: () => this.panel.flying((this.controls.flying = !this.controls.flying)),
      reset: () => this.reset(),
      goTo: (index) => this.goTo(index),
      step: (by) => this.step(by),
      view: () => this.view.camera,
      goToView: (camera) => {
        this.view.goTo(camera);
        this.moved(-1);
      },
      saveView: () => this.keyframes.save(),
      playPath: () => (this.journey ? this.stop() : this.play()),
      pathChanged: () => this.stop(),
      degree: (degree) => {
        this.settings.sh_degree = degree;
        this.askFrame();
      },
    };
  }

  // The camera of the next frame: the view's camera, fitted to the window.
  camera() {
    if (this.exact) return this.exact;
    const side = (length) => Math.max(1, Math.round(length * (window.devicePixelRatio || 1)));
    return fitted(this.view.camera, side(this.canvas.clientWidth), side(this.canvas.clientHeight));
  }

  // For programs: draws with exactly this camera, regardless of the window's size, and returns float32 RGB with the
  // first row on top. The camera stays until the user moves.
  async setCamera(camera) {
    this.stop();
    this.exact = camera;
    await this.settled();
    return { width: camera.W, height: camera.H, pixels: this.renderer.pixels() };
  }

  // Resolves once the picture shows the current camera with its splats sorted.
  async settled() {
    const camera = this.camera();
    await this.levels?.load(camera);
    await this.sorter.sort(camera);
    this.draw(camera);
  }

  // Shows other splats in place of all: of this number and degree. Resolves once they are drawn.
  async replace(facts, splats) {
    const all = { ...this.facts, ...facts };
    await this.sorter.replace(splats.means, () => this.renderer.replace(all, splats));
    this.panel.counted(all.count);
    await this.settled();
  }

  // Other splats are shown now.
  changed() {
    this.panel.showing(this.levels.count);
    this.askFrame();
  }

  reset() {
    this.view.reset();
    this.moved(this.facts.start.index);
  }

  // Makes the visible surface at a window position (CSS pixels) the pivot; no change if nothing is visible there.
  orbitAround(x, y) {
    this.stop();
    const camera = this.camera();
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    const column = Math.min(camera.W - 1, Math.max(0, Math.floor(((x - left) / width) * camera.W)));
    const row = Math.min(camera.H - 1, Math.max(0, Math.floor(((y - top) / height) * camera.H)));
    const depth = this.depthAt(camera, column, row);
    if (depth !== null) {
      this.view.orbitAround(pointAt(camera, column, row, depth));
      this.panel.point(x, y);
    }
    this.askFrame();
  }

  // Camera depth of the visible surface at a pixel; null if there is none.
  depthAt(camera, column, row) {
    return this.lost ? null : this.renderer.surface(camera, this.settings, column, row);
  }

  goTo(index) {
    this.view.goTo(this.facts.cameras[index]);
    this.moved(index);
  }

  // Goes to the next or previous camera; to the first or last one if the view is at none.
  step(by) {
    const { length } = this.facts.cameras;
    const from = this.cameraIndex < 0 && by < 0 ? 0 : this.cameraIndex;
    if (length) this.goTo((from + by + length) % length);
  }

  // Plays the camera path from its beginning until its end, in a loop forever, or until the user moves.
  play() {
    if (!this.keyframes.playable) return;
    this.moved(-1);
    this.journey = { curve: this.keyframes.curve(), began: null };
    this.keyframes.playing(true);
  }

  stop() {
    if (this.journey) this.keyframes.playing(false);
    this.journey = null;
  }

  // Moves the view to where the journey is now.
  follow(now) {
    const { curve, began } = this.journey;
    if (began === null) this.journey.began = now;
    const seconds = (now - this.journey.began) / 1000;
    this.view.goTo(this.keyframes.camera(curve.pose(seconds)));
    if (!curve.loop && seconds >= curve.seconds) this.stop();
    this.askFrame();
  }

  moved(cameraIndex) {
    this.stop();
    this.exact = null;
    this.cameraIndex = cameraIndex;
    this.panel.mark(cameraIndex);
    this.askFrame();
  }

  askFrame() {
    this.frameAsked ||= requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.frameAsked = 0;
    const seconds = this.lastFrame ? (now - this.lastFrame) / 1000 : 0;
    if (this.controls.advance(Math.min(seconds, LONGEST_STEP))) this.moved(-1);
    if (this.journey) this.follow(now);
    const camera = this.camera();
    this.draw(camera);
    this.levels?.load(camera).catch((error) => this.levels.fail(error));
    if (!this.sorter.running && !this.sorter.fits(camera)) this.sorter.sort(camera).then(() => this.askFrame(), fail);
    this.time(now, seconds);
  }

  draw(camera) {
    if (this.lost) return;
    if (this.canvas.width !== camera.W) this.canvas.width = camera.W;
    if (this.canvas.height !== camera.H) this.canvas.height = camera.H;
    this.renderer.draw(camera, this.settings);
    this.renderer.show();
  }

  // Frames are drawn only while something moves; otherwise there is no frame rate.
  time(now, seconds) {
    this.lastFrame = now;
    if (seconds) this.smoothed = this.smoothed ? (1 - SMOOTHING) * this.smoothed + SMOOTHING * seconds : seconds;
    if (this.smoothed) this.panel.rate(1 / this.smoothed);
    clearTimeout(this.rest);
    this.rest = setTimeout(() => {
      [this.lastFrame, this.smoothed] = [0, 0];
      this.panel.atRest();
    }, REST);
  }

  lose() {
    this.lost = true;
    if (this.levels) this.levels.stopped = true;
    say("The graphics processor stopped drawing this page; reload it.");
  }
}

function fail(error) {
  say(error?.message || String(error));
}

async function start() {
  const splats = FACTS.lod ? null : await unpackSplats(FACTS);
  const viewer = splats ? new Viewer(FACTS, splats) : streamed(FACTS);
  if (viewer.levels) await viewer.sorter.sort(viewer.camera()); // the first picture comes before the last splat
  else await viewer.settled();
  window.viewer = viewer;
  if (!viewer.levels?.regions.some(({ levels }) => levels.length)) say("");
  dispatchEvent(new CustomEvent("viewer", { detail: { viewer, splats } })); // for further parts of the page
}

// A viewer that loads levels of detail from the folder of this page's server.
function streamed(facts) {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) throw new Error("This page draws with WebGL2, which this browser lacks or has switched off. Allow hardware acceleration, use another browser, or make a video: gsplat-edu render");
  const budget = facts.lod.budget ?? machineBudget(gl, facts.sh_degree);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  let viewer = null;
  const levels = new Levels(facts, budget, () => {
    say("");
    viewer.changed();
  });
  viewer = new Viewer({ ...facts, count: levels.capacity }, { means: hidden(levels.capacity) }, levels);
  return viewer;
}

function hidden(count) {
  return new Float32Array(3 * count).fill(NaN);
}

addEventListener("error", (event) => fail(event.error));
addEventListener("unhandledrejection", (event) => fail(event.reason));
addEventListener("DOMContentLoaded", () => start().catch(fail));

// The page: unpack, then draw whenever something has changed.
"use strict";

const SMOOTHING = 0.1; // share of the newest frame in the frame rate
const REST = 400; // milliseconds without a frame after which nothing moves
const LONGEST_STEP = 0.1; // seconds that a held key moves the view for at once, however long a frame took

class Viewer {
  constructor(facts, splats) {
    this.facts = facts;
    this.settings = { ...facts.settings };
    this.canvas = element("canvas");
    this.renderer = new Renderer(this.canvas, splats, facts);
    this.sorter = new Sorter(splats.means, facts.near, (order) => this.renderer.setOrder(order));
    const eyes = facts.cameras.map(({ eye }) => eye);
    this.view = new View(facts.start, eyes);
    this.cameraIndex = facts.start.index;
    this.exact = null; // the camera that setCamera was given, until somebody moves
    this.lost = false;
    this.frameAsked = 0;
    this.lastFrame = 0; // 0 after a rest
    this.smoothed = 0; // seconds a frame
    const actions = this.actions();
    this.panel = new Panel(facts, actions);
    this.controls = new Controls(this.canvas, this.view, actions);
    this.panel.mark(this.cameraIndex);
    addEventListener("resize", () => this.askFrame());
    this.canvas.addEventListener("webglcontextlost", () => this.lose());
    this.askFrame();
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
      degree: (degree) => {
        this.settings.sh_degree = degree;
        this.askFrame();
      },
    };
  }

  // The camera of the next frame: the view's, in the window as it is.
  camera() {
    if (this.exact) return this.exact;
    const side = (length) => Math.max(1, Math.round(length * (window.devicePixelRatio || 1)));
    return fitted(this.view.camera, side(this.canvas.clientWidth), side(this.canvas.clientHeight));
  }

  // For programs: draws with exactly this camera, whatever the window's size, and gives the picture as float32, RGB,
  // the first row on top. The camera stays until somebody moves.
  async setCamera(camera) {
    this.exact = camera;
    await this.settled();
    return { width: camera.W, height: camera.H, pixels: this.renderer.pixels() };
  }

  // Resolves when the picture is that of the camera, its splats in order.
  async settled() {
    const camera = this.camera();
    await this.sorter.sort(camera);
    this.draw(camera);
  }

  reset() {
    this.view.reset();
    this.moved(this.facts.start.index);
  }

  // Lets orbits go around what is seen at a place of the window, in CSS pixels; nothing changes where nothing is seen.
  orbitAround(x, y) {
    const camera = this.camera();
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    const column = Math.min(camera.W - 1, Math.max(0, Math.floor(((x - left) / width) * camera.W)));
    const row = Math.min(camera.H - 1, Math.max(0, Math.floor(((y - top) / height) * camera.H)));
    const depth = this.lost ? null : this.renderer.surface(camera, this.settings, column, row);
    if (depth !== null) {
      this.view.orbitAround(pointAt(camera, column, row, depth));
      this.panel.point(x, y);
    }
    this.askFrame();
  }

  goTo(index) {
    this.view.goTo(this.facts.cameras[index]);
    this.moved(index);
  }

  // Goes to the next camera, or to the first or last one where the view stands at none.
  step(by) {
    const { length } = this.facts.cameras;
    const from = this.cameraIndex < 0 && by < 0 ? 0 : this.cameraIndex;
    if (length) this.goTo((from + by + length) % length);
  }

  moved(cameraIndex) {
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
    const camera = this.camera();
    this.draw(camera);
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

  // Frames are drawn only while something moves: only then is there a rate.
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
    say("The graphics processor dropped this page; reload it.");
  }
}

function fail(error) {
  say(error?.message || String(error));
}

async function start() {
  const viewer = new Viewer(FACTS, await unpackSplats(FACTS));
  await viewer.settled();
  say("");
  window.viewer = viewer;
}

addEventListener("error", (event) => fail(event.error));
addEventListener("unhandledrejection", (event) => fail(event.reason));
addEventListener("DOMContentLoaded", () => start().catch(fail));

// The viewer of a page of splats: draws whenever something changes.

import { fitted, pointAt, View } from "./camera.js";
import { element, fail, followSize, hasSize, say } from "./common.js";
import { Compare } from "./compare.js";
import { Controls } from "./controls.js";
import { Renderer } from "./draw.js";
import { FACTS } from "./facts.js";
import { Flight } from "./flight.js";
import { Frustums } from "./frustums.js";
import { Guide } from "./guide.js";
import { Keyframes } from "./keyframes.js";
import { Meshes } from "./mesh.js";
import { DETAILS, Pace, reduced, SPARING, STILL } from "./pace.js";
import { Panel } from "./panel.js";
import { Seen } from "./seen.js";
import { Sorter } from "./sorter.js";

const SMOOTHING = 0.1; // weight of the newest frame in the frame rate
const REST = 400; // milliseconds without a frame after which the view counts as still
const LONGEST_STEP = 0.1; // most seconds of movement per frame for a held key, however long the frame took

const STILL_PREFERRED = matchMedia("(prefers-reduced-motion: reduce)"); // the view then jumps

export class Viewer {
  constructor(facts, splats, levels = null) {
    this.facts = facts;
    this.levels = levels; // of detail
    this.settings = { ...facts.settings };
    this.canvas = element("canvas");
    this.renderer = this.makeRenderer(splats);
    this.sorter = new Sorter(splats, facts.near, (order, thinning) => this.renderer.setOrder(order, thinning));
    const eyes = facts.cameras.filter(({ saved }) => !saved).map(({ eye }) => eye);
    this.view = new View(facts.start, eyes);
    this.cameraIndex = facts.start.index;
    this.exact = null; // the camera given to setCamera, until the user moves
    this.lost = false;
    this.meshes = null; // beside the splats
    this.seen = this.compare = this.guide = this.headset = null; // see the modules of these names
    this.pace = new Pace();
    this.movedAt = -Infinity;
    this.unseen = false; // whether a change waits for its first picture
    this.gauged = false;
    this.isTraining = false; // the scene, on this computer
    this.isWhole = false; // whether the screen shows the current view with all splats at full resolution
    this.catching = this.outdated = this.timing = false; // see catchUp() and measure()
    this.frameAsked = 0;
    this.lastFrame = 0; // 0 while the view is still
    this.smoothed = 0; // seconds per frame
    const actions = this.actions();
    this.panel = new Panel(facts, actions);
    this.frustums = new Frustums(this);
    this.keyframes = new Keyframes(facts, actions);
    this.journey = null; // the curve and the time it began, while the camera path is played
    this.flight = null; // to a camera, with its index, while the view moves there
    this.controls = new Controls(this.canvas, this.view, actions, facts.cameras.length);
    this.panel.mark(this.cameraIndex);
    this.levels?.attach(this.renderer, this.sorter);
    this.sized = followSize(this.canvas, () => this.refresh());
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
      guide: () => this.guide?.toggle(),
      compare: () => this.compare?.toggle(),
      seen: () => this.seen?.toggle(),
      headset: () => this.headset?.toggle(),
      slide: (by) => this.compare?.slide(by),
      dismiss: () => this.dismiss(),
      degree: (degree) => {
        this.settings.sh_degree = degree;
        this.refresh();
      },
    };
  }

  // The camera of the next frame: the view's camera, fitted to the window.
  camera() {
    if (this.exact) return this.exact;
    const side = (length) => Math.max(1, Math.round(length * (window.devicePixelRatio || 1)));
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map(side);
    return fitted(this.view.camera, width, height);
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
    this.isWhole = true;
    this.compare?.place();
  }

  // Finds out how fast this computer draws the scene, by a coarse picture of it.
  async gauge() {
    const { count } = (this.renderer.next ?? this.renderer).facts;
    const least = DETAILS.at(-1);
    if (this.gauged || count <= least.most) return;
    this.gauged = true;
    const camera = this.camera();
    await this.sorter.sort(camera, least.most);
    const times = [1, 2].slice(this.isTraining ? 1 : 0).map(() => {
      const began = performance.now();
      this.coarse(camera, least);
      this.renderer.finish();
      return performance.now() - began;
    }); // the first one compiles the shaders as well; during a training, drawSparing() corrects that
    this.pace.expect(times.at(-1), least, count);
  }

  // Shows other splats in place of all: of this number and degree. Resolves once they are drawn.
  async replace(facts, splats) {
    const all = { ...this.facts, ...facts };
    await this.sorter.replace(splats, () => this.renderer.replace(all, splats));
    this.panel.counted(all.count);
    await this.gauge();
    await (this.pace.slow ? this.followed() : this.settled());
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
  async orbitAround(x, y) {
    this.stop();
    const camera = this.camera();
    if (this.pace.slow) await this.sorter.sort(camera, this.pace.detail.most); // the search draws many times
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
    if (this.meshes?.covers(camera, column)) return this.meshes.depthAt(camera, column, row);
    return this.lost ? null : this.renderer.surface(camera, this.settings, column, row);
  }

  goTo(index) {
    this.arrive(this.facts.cameras[index], index);
  }

  // index: the camera's in the page's list, or -1.
  arrive(camera, index) {
    this.view.goTo(camera);
    this.moved(index);
  }

  // Moves the view to a camera; at once if the visitor prefers less motion.
  flyTo(camera, index) {
    if (STILL_PREFERRED.matches) return this.arrive(camera, index);
    const flight = new Flight(this.view.camera, camera);
    this.moved(-1);
    this.flight = { flight, index };
    return undefined;
  }

  // Moves the view to where the flight is now.
  soar(now) {
    const { flight, index } = this.flight;
    const camera = flight.camera(now);
    if (!camera) return this.arrive(flight.to, index);
    this.view.goTo(camera);
    return this.askFrame();
  }

  // Ends the tour, the comparison with photos, or VR.
  dismiss() {
    this.headset?.end();
    this.guide?.close();
    if (this.compare?.on) this.compare.toggle();
  }

  // Goes to the next or previous step of the tour, photo of the comparison, or camera; to the first or last one if the
  // view is at none.
  step(by) {
    if (this.guide?.on) return this.guide.step(by);
    if (this.compare?.on) return this.compare.step(by);
    const { length } = this.facts.cameras;
    const from = this.cameraIndex < 0 && by < 0 ? 0 : this.cameraIndex;
    if (length) this.goTo((from + by + length) % length);
    return undefined;
  }

  // Plays the camera path from the playhead until its end, in a loop forever, or until the user moves.
  play() {
    if (!this.keyframes.playable) return;
    this.moved(-1);
    this.journey = { curve: this.keyframes.curve(), from: this.keyframes.timeline.from, began: null };
    this.keyframes.playing(true);
  }

  stop() {
    if (this.journey) this.keyframes.playing(false);
    this.journey = this.flight = null;
  }

  // Moves the view to where the journey is now.
  follow(now) {
    const { curve, from, began } = this.journey;
    if (began === null) this.journey.began = now;
    const seconds = from + (now - this.journey.began) / 1000;
    this.keyframes.timeline.reached(seconds);
    this.view.goTo(this.keyframes.camera(curve.pose(seconds)));
    if (!curve.loop && seconds >= curve.seconds) this.stop();
    this.askFrame();
  }

  moved(cameraIndex) {
    this.stop();
    this.exact = null;
    this.movedAt = performance.now();
    this.unseen = true;
    this.cameraIndex = cameraIndex;
    this.isWhole = false; // the screen shows another view until the next frame
    this.panel.mark(cameraIndex);
    this.compare?.mark(cameraIndex);
    this.askFrame();
  }

  // What is seen from here has changed. A slow page shows that in a coarse picture first, as if the view had moved.
  refresh() {
    this.movedAt = performance.now();
    this.unseen = true;
    this.askFrame();
  }

  // Whether the page draws nothing: it cannot, its frame is hidden, or a headset shows the scene.
  get paused() {
    return this.lost || !(this.exact || hasSize(this.canvas)) || Boolean(this.headset?.session);
  }

  askFrame() {
    if (this.headset?.session) return;
    this.frameAsked ||= requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.frameAsked = 0;
    if (!this.exact && !hasSize(this.canvas)) return;
    const seconds = this.lastFrame ? (now - this.lastFrame) / 1000 : 0;
    if (this.controls.advance(Math.min(seconds, LONGEST_STEP))) this.moved(-1);
    if (this.journey) this.follow(now);
    if (this.flight) this.soar(now);
    const camera = this.camera();
    this.levels?.load(camera).catch((error) => this.levels.fail(error));
    this.isWhole = false;
    if (this.pace.slow) {
      this.lastFrame = now; // for held keys
      clearTimeout(this.rest);
      this.outdated = true;
      this.catchUp().catch(fail);
      return;
    }
    this.draw(camera);
    this.measure();
    if (!this.sorter.running && !this.sorter.fits(camera)) this.sorter.sort(camera).then(() => this.askFrame(), fail);
    this.isWhole = this.sorter.fits(camera);
    this.compare?.place(); // its photo waits for the picture
    if (this.isWhole) this.onRest?.();
    this.time(now, seconds);
  }

  draw(camera) {
    if (this.paused) return;
    this.renderer.draw(camera, this.settings);
    this.put(camera);
  }

  // Shows what is drawn as the picture of a camera.
  put(camera) {
    if (this.canvas.width !== camera.W) this.canvas.width = camera.W;
    if (this.canvas.height !== camera.H) this.canvas.height = camera.H;
    this.renderer.show();
    this.meshes?.show(camera);
    this.compare?.place();
    this.frustums.place(camera);
    element("poster")?.classList.add("gone"); // printed all the same
  }

  // Shows the picture again, after a change of what lies over the splats.
  repaint() {
    if (this.isWhole && !this.paused) this.put(this.camera());
    else this.refresh();
  }

  // Draws with less detail.
  coarse(camera, { share }) {
    if (this.paused) return;
    this.renderer.draw(reduced(camera, share), this.settings);
    this.put(camera);
  }

  // Notes how long a whole picture takes.
  async measure() {
    if (this.timing || !this.renderer.drawn) return;
    this.timing = true;
    const taken = await this.renderer.drawn();
    this.timing = false;
    if (document.hidden || this.paused) return;
    this.pace.took(taken, this.renderer.count);
    if (this.pace.slow) this.askFrame();
  }

  // Draws pictures until the newest is shown: coarse ones while the view moves, then the whole one.
  async catchUp() {
    if (this.catching) return;
    this.catching = true;
    try {
      while (this.outdated && !this.paused) {
        this.outdated = false;
        // however late the page comes to it, a change is not first seen in the whole picture
        if (this.isMoving() || this.unseen) await this.drawCoarse();
        else if (this.isTraining) await this.drawSparing();
        else if (!(await this.drawWhole())) this.outdated = true;
      }
    } finally {
      this.catching = false;
    }
  }

  isMoving() {
    return (
      this.journey !== null ||
      this.flight !== null ||
      this.controls.held.size > 0 ||
      performance.now() - this.movedAt < STILL
    );
  }

  async drawCoarse() {
    const { detail } = this.pace;
    this.unseen = false;
    const began = performance.now();
    const camera = this.camera();
    await this.sorter.sort(camera, detail.most);
    this.coarse(camera, detail);
    this.pace.took(await this.renderer.drawn(), this.renderer.facts.count);
    this.panel.coarse(1000 / (performance.now() - began));
    clearTimeout(this.rest);
    this.rest = setTimeout(() => this.askFrame(), STILL);
  }

  // The picture while a training needs the processor.
  async drawSparing() {
    const camera = this.camera();
    await this.sorter.sort(camera, SPARING.most);
    this.coarse(camera, SPARING);
    this.pace.expect(await this.renderer.drawn(), SPARING, this.renderer.facts.count);
    if (this.pace.slow) this.rested(false);
    else this.askFrame();
  }

  // Draws everything in parts, which a movement interrupts. The screen keeps its picture until all are drawn. Returns
  // whether they are.
  async drawWhole() {
    const { renderer } = this;
    const camera = this.camera();
    this.panel.completing();
    await this.sorter.sort(camera);
    const begun = renderer.begin(camera, [...this.settings.background, 1]);
    for (let from = 0; from < renderer.count; ) {
      const to = Math.min(from + this.pace.part, renderer.count);
      renderer.drawPart(camera, this.settings, from, to);
      this.pace.partTook(await renderer.drawn());
      if (this.paused || this.outdated || renderer.begun !== begun) return false;
      from = to;
    }
    this.put(camera);
    this.rested(true);
    return true;
  }

  // A picture of the still view is on the screen.
  rested(isWhole) {
    this.isWhole = isWhole;
    this.lastFrame = 0;
    this.compare?.place();
    this.panel.atRest();
    this.onRest?.();
  }

  // Resolves once a picture of the still view is on the screen.
  followed() {
    return new Promise((resolve) => {
      this.onRest = resolve;
      this.askFrame();
    });
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
    this.headset?.end();
    if (this.levels) this.levels.stopped = true;
    say("The graphics processor stopped drawing this page; reload it.");
  }
}

// Shows further parts of the page, then the first picture. `splats`: what the viewer was made of; null with levels of detail.
export async function showScene(viewer, splats) {
  await viewer.sized;
  if (FACTS.meshes) viewer.meshes = await Meshes.open(viewer);
  if (FACTS.seen) viewer.seen = await Seen.open(viewer);
  if (FACTS.photos) viewer.compare = await Compare.open(viewer);
  viewer.guide = Guide.of(viewer);
  if (viewer.levels)
    await viewer.sorter.sort(viewer.camera()); // the first picture comes before the last splat
  else {
    await viewer.gauge();
    if (viewer.pace.slow)
      viewer.askFrame(); // the coarse picture is the first one
    else await viewer.settled();
  }
  window.viewer = viewer;
  if (!viewer.levels?.regions.some(({ levels }) => levels.length)) say("");
  dispatchEvent(new CustomEvent("viewer", { detail: { viewer, splats } })); // for further parts of the page
}

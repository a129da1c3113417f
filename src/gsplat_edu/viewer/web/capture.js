// The page of a capture: unpacks its points, then draws whenever something changes.

import { fitted, View } from "./camera.js";
import { Cameras, projected } from "./capture_cameras.js";
import { CaptureRenderer } from "./capture_draw.js";
import { MatchPanel, readMatches } from "./capture_matches.js";
import { CapturePanel, numbered, tellFrame } from "./capture_panel.js";
import { Photos } from "./capture_photos.js";
import { RegionTool } from "./capture_region.js";
import { element, fail, followSize, hasSize, say, startPage } from "./common.js";
import { Controls } from "./controls.js";
import { FACTS } from "./facts.js";
import { inflated } from "./scene.js";

const SLOW = 40; // milliseconds per frame above which fewer points are drawn while the view moves
const FAST = 20; // below which more are
const FEWEST = 5000; // points while the view moves
const STILL = 250; // milliseconds without a movement after which all points are drawn
const CLICK = 5; // most CSS px that the pointer moves in a click
const ASK_AGAIN = 1500; // milliseconds between two questions for the doctor's findings

class CaptureView {
  constructor(facts, points, matches) {
    this.facts = facts;
    this.canvas = element("canvas");
    this.cameras = new Cameras(facts);
    this.photos = new Photos();
    this.matches = matches;
    this.panel = new CapturePanel(facts, this.cameras, this.photos, this.actions());
    this.view = new View(facts.start, []);
    this.positions = new Float32Array(points.buffer, 0, 3 * facts.count);
    this.moving = facts.count; // points drawn while the view moves
    this.movedAt = this.lastFrame = -Infinity;
    this.frameAsked = 0;
    this.through = null; // the camera that is looked through, until the view moves
    this.lost = false;
    this.leaving = Promise.resolve(); // once every photo that was pressed is left out, or used again
    this.controls = new Controls(this.canvas, this.view, this.actions(), facts.cameras.length);
    this.renderer = null;
    this.region = new RegionTool(this);
    this.matchPanel = new MatchPanel(matches, this.cameras, {
      choose: (index) => this.choose(index),
      repaint: () => this.match(),
    });
    this.listen();
    this.paint();
  }

  // Draws from now on.
  open(points) {
    this.renderer = new CaptureRenderer(this.canvas, this.facts, points, this.cameras);
    this.askFrame();
  }

  actions() {
    return {
      moved: () => this.moved(),
      awake: () => this.askFrame(),
      shown: () => this.camera(),
      orbitAround: (x, y) => this.orbitAround(x, y),
      fly: () => (this.controls.flying = !this.controls.flying),
      reset: () => this.goTo(this.facts.start.camera),
      help: () => this.panel.help(),
      saveView: () => {},
      playPath: () => {},
      step: (by) => this.step(by),
      choose: (index) => this.choose(index),
      close: () => this.choose(-1),
      look: () => this.look(),
      leave: () => this.leave(),
      matches: () => this.matchPanel.toggle(),
      repaint: () => this.paint(),
      size: (factor) => {
        this.cameras.scale = this.cameras.base * factor;
        this.askFrame();
      },
    };
  }

  listen() {
    const { canvas } = this;
    let pressed = null;
    canvas.addEventListener("pointerdown", ({ clientX: x, clientY: y, button, isPrimary }) => {
      pressed = isPrimary && button === 0 ? { x, y } : null;
      this.hover(-1, x, y);
    });
    canvas.addEventListener("pointerup", ({ clientX: x, clientY: y, isPrimary }) => {
      if (isPrimary && pressed && Math.hypot(x - pressed.x, y - pressed.y) <= CLICK) this.choose(this.at(x, y));
      pressed = null;
    });
    canvas.addEventListener("pointermove", ({ clientX: x, clientY: y, buttons, pointerType }) => {
      if (!buttons && pointerType === "mouse") this.pointed = { x, y };
      if (this.pointed && !this.frameAsked) this.askFrame();
    });
    canvas.addEventListener("pointerleave", ({ clientX: x, clientY: y }) => {
      this.pointed = null;
      this.hover(-1, x, y);
    });
    canvas.addEventListener("webglcontextlost", () => {
      this.lost = true;
      say("The graphics processor stopped drawing this page; reload it.");
    });
    addEventListener("keydown", ({ key, repeat, ctrlKey, metaKey, altKey }) => {
      if (repeat || ctrlKey || metaKey || altKey) return;
      const action = { Escape: "close", t: "look", x: "leave", m: "matches" }[key];
      if (action && this.cameras.chosen >= 0) this.actions()[action]();
    });
    followSize(this.canvas, () => this.askFrame());
    matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => this.paint());
  }

  get dense() {
    return window.devicePixelRatio || 1;
  }

  // The camera of the next frame: the view's camera, fitted to the window.
  camera() {
    const side = (length) => Math.max(1, Math.round(length * this.dense));
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return fitted(this.view.camera, side(width), side(height), Math.round(this.panel.covered() * this.dense));
  }

  // The camera at a place of the window, CSS px; -1 if there is none.
  at(x, y) {
    const { left, top } = this.canvas.getBoundingClientRect();
    return this.cameras.at(x - left, y - top, this.camera(), this.dense);
  }

  hover(index, x, y) {
    this.panel.hover(index, x, y);
    this.canvas.style.cursor = index < 0 ? "" : "pointer";
    if (index === this.cameras.over) return;
    this.cameras.over = index;
    this.restyle();
  }

  choose(index) {
    if (index >= 0 && this.region.drawing) return undefined; // its panel would lie over that of the box
    this.cameras.chosen = index;
    this.restyle();
    this.match();
    return this.panel.choose(index);
  }

  // Another photo is chosen, or its matched points are to be shown or hidden.
  match() {
    this.matchPanel.choose(this.cameras.chosen);
    this.renderer?.match(this.matchPanel.positions);
    this.askFrame();
  }

  // Chooses the next or previous photo; the first or last one if none is chosen. Looking through one, looks through it.
  step(by) {
    const { length } = this.cameras.list;
    const looked = this.through !== null;
    const from = this.cameras.chosen < 0 && by < 0 ? 0 : this.cameras.chosen;
    this.choose((from + by + length) % length);
    if (looked) this.look();
  }

  // Moves the view into the chosen camera, and lays its photo over the picture.
  async look() {
    const camera = this.cameras.list[this.cameras.chosen];
    if (!camera) return;
    this.goTo(camera);
    this.through = camera;
    const picture = element("through");
    picture.hidden = true;
    if (!this.cameras.shapes[camera.shape].flat) return; // the photo of a wide lens does not fit
    const address = await this.photos.load(camera.photo, 1024).catch(() => null);
    if (!address || this.through !== camera) return;
    picture.src = address;
    this.lay(this.camera());
    picture.hidden = false;
  }

  // Leaves the chosen photo out, or takes it back. A second press waits for the answer to the first one.
  leave() {
    const camera = this.cameras.list[this.cameras.chosen];
    if (camera) this.leaving = this.leaving.then(() => this.leaveNow(camera));
    return this.leaving;
  }

  async leaveNow(camera) {
    const out = !camera.left_out;
    try {
      const all = new Set(await this.photos.leaveOut(camera.photo, !out));
      for (const one of this.cameras.list) one.left_out = all.has(one.photo);
      this.panel.trouble("");
      this.panel.say(out ? `${camera.name} is left out` : `${camera.name} is used again`);
      this.paint();
      tellFrame("left", { photo: camera.photo, out });
    } catch (error) {
      this.panel.trouble(error.message);
    }
  }

  // For a page around this one: marks photos, by their names or paths, with the names of findings.
  mark(marks) {
    const found = (camera) => marks.get(camera.photo) ?? marks.get(camera.name) ?? [];
    this.cameras.list.forEach((camera, i) => {
      camera.marks = [...new Set([...this.facts.cameras[i].marks, ...found(camera)])];
    });
    this.paint();
  }

  // For a page around this one: photos were left out there, or taken back; a Map from photos to whether they are left out.
  left(changes) {
    const other = this.cameras.list.filter(({ photo, left_out: out }) => (changes.get(photo) ?? out) !== out);
    for (const camera of other) camera.left_out = changes.get(camera.photo);
    if (other.length) this.paint();
  }

  // Asks the server what the doctor found, until it knows.
  async ask() {
    this.panel.doctor("The doctor examines the photos ...");
    for (;;) {
      const answer = await fetch(this.facts.findings).catch(() => null);
      if (!answer?.ok) return this.panel.doctor("");
      const { done, marks, trouble } = await answer.json();
      if (done) {
        this.mark(new Map(Object.entries(marks)));
        const count = this.cameras.list.filter((camera) => camera.marks.length).length;
        return this.panel.doctor(
          trouble ||
            (count
              ? `The doctor found something about ${numbered(count, "photo")}.`
              : "The doctor found nothing about single photos."),
        );
      }
      await new Promise((resolve) => setTimeout(resolve, ASK_AGAIN));
    }
  }

  goTo(camera) {
    this.view.goTo(camera);
    this.moved();
  }

  // Makes the point of the capture nearest to a place of the window (CSS px) the pivot.
  orbitAround(x, y) {
    const shown = this.camera();
    const { left, top } = this.canvas.getBoundingClientRect();
    const [u, v] = [(x - left) * this.dense - 0.5, (y - top) * this.dense - 0.5];
    let [best, least] = [null, (30 * this.dense) ** 2];
    for (let i = 0; i < this.positions.length; i += 3) {
      const point = [this.positions[i], this.positions[i + 1], this.positions[i + 2]];
      const place = projected(point, shown);
      const away = place ? (place[0] - u) ** 2 + (place[1] - v) ** 2 : Infinity;
      if (away < least) [best, least] = [point, away];
    }
    if (best) this.view.orbitAround(best);
  }

  moved() {
    this.through = null;
    element("through").hidden = true;
    this.movedAt = performance.now();
    this.askFrame();
  }

  // Colours, findings or what is shown have changed.
  paint() {
    const style = getComputedStyle(document.body);
    this.colors = (name) => rgbOf(style.getPropertyValue(`--${name}`).trim());
    this.panel.tell();
    this.restyle();
  }

  // Another camera is chosen, or under the pointer.
  restyle() {
    this.cameras.paint(this.colors, this.panel.showsPath);
    this.renderer?.restyled();
    this.askFrame();
  }

  askFrame() {
    this.frameAsked ||= requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.frameAsked = 0;
    if (this.lost || !this.renderer || !hasSize(this.canvas)) return;
    const taken = now - this.lastFrame;
    if (this.controls.advance(Math.min(taken / 1000, 0.1))) this.moved();
    const isMoving = performance.now() - this.movedAt < STILL;
    if (isMoving && !this.isWhole) {
      if (taken > SLOW) this.moving = Math.max(FEWEST, this.moving >> 1);
      else if (taken < FAST) this.moving = Math.min(this.facts.count, 2 * this.moving);
    }
    this.lastFrame = now;
    this.draw(this.camera(), isMoving ? this.moving : this.facts.count);
    if (this.pointed && !isMoving) this.hover(this.at(this.pointed.x, this.pointed.y), this.pointed.x, this.pointed.y);
    clearTimeout(this.rest);
    if (isMoving) this.rest = setTimeout(() => this.askFrame(), STILL + 10);
    this.isWhole = !isMoving;
  }

  draw(camera, points) {
    const { near } = this.facts;
    this.renderer.draw(camera, {
      near,
      dense: this.dense,
      ground: this.colors("ground"),
      mark: this.colors("match"),
      points: this.panel.showsPoints ? points : 0,
    });
    this.region.paint(camera);
    this.markMissing(camera);
    if (this.through) this.lay(camera);
  }

  // Puts the mark where photos are missing.
  markMissing(camera) {
    const { gap } = this.facts;
    const place = gap && projected(gap[gap.length >> 1], camera);
    element("missing").hidden = !place;
    if (place)
      [element("missing").style.left, element("missing").style.top] = place.map((px) => `${(px + 0.5) / this.dense}px`);
  }

  // Lays the photo over the place of its camera's image.
  lay(shown) {
    const { fx, cx, cy, W, H } = this.through;
    const factor = shown.fx / fx;
    const place = {
      left: shown.cx + 0.5 - factor * (cx + 0.5),
      top: shown.cy + 0.5 - factor * (cy + 0.5),
      width: factor * W,
      height: factor * H,
    };
    for (const [name, px] of Object.entries(place)) element("through").style[name] = `${px / this.dense}px`;
  }
}

// [R, G, B] of a colour #rgb or #rrggbb.
function rgbOf(text) {
  const digits = text.slice(1);
  return [0, 1, 2].map((i) =>
    digits.length === 3 ? 17 * parseInt(digits[i], 16) : parseInt(digits.slice(2 * i, 2 * i + 2), 16),
  );
}

async function start() {
  const points = await inflated(document.querySelectorAll("script.points"), 15 * FACTS.count);
  const matches = await readMatches(FACTS);
  const viewer = new CaptureView(FACTS, points, matches);
  window.viewer = viewer;
  tellFrame("started");
  viewer.region.load().catch((error) => viewer.region.say(error.message));
  if (FACTS.findings) viewer.ask().catch(fail);
  viewer.open(points);
  say("");
}

startPage(start);

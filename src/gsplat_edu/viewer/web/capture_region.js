// The region of interest of a capture: a box that is drawn in 3D. Trainings learn only what the photos show of it.
//
// It has the members that `Gizmo` and `Overlay` need of an editor's tools. The box is in the page's coordinates; the
// server's file has those of the capture, which differ by `facts.origin`.

import { SMALL, tellFrame } from "./capture_panel.js";
import { element } from "./common.js";
import { Gizmo } from "./edit_gizmo.js";
import { numberFields } from "./edit_gizmo_panel.js";
import { Overlay } from "./edit_overlay.js";
import { boxHandles, boxLines, sideAt, sideDragged } from "./edit_shapes.js";
import { plus } from "./vectors.js";

const ELSEWHERE = {
  saved: "Another tab has saved a box. Yours is not saved yet; saving it replaces the other one.",
  removed: "Another tab has removed the saved box. Yours is not saved yet.",
};

// The numbers of a box as a text; empty without a box.
const numbersOf = (region) => (region ? [region.center, region.rotation, region.half].flat(2).join() : "");

export class RegionTool {
  constructor(viewer) {
    Object.assign(this, { viewer, editor: this, tool: "box", stroke: null, shape: null, drawing: false, before: null });
    this.saved = null;
    this.loaded = false; // whether the server has said which box there is
    Object.assign(this, { questions: 0, stored: "" }); // for the box; the numbers of the one that the server has
    this.overlay = new Overlay(viewer);
    this.gizmo = new Gizmo(this);
    this.center = numberFields("region-center");
    this.half = numberFields("region-half");
    const listen = (name, method) => addEventListener(name, (event) => method.call(this, event), true);
    listen("pointerdown", this.down); // before the page's own controls
    listen("pointermove", this.move);
    listen("pointerup", this.up);
    listen("pointercancel", this.up);
    listen("keydown", this.keyDown);
    const pressed = { draw: "draw", remove: "remove", save: "save", cancel: "close" };
    for (const [id, method] of Object.entries(pressed)) {
      element(`region-${id}`).addEventListener("click", () =>
        Promise.resolve(this[method]()).catch((error) => this.say(error.message)),
      );
    }
    element("region-tools").addEventListener("input", ({ target }) => this.input(target));
    this.changed();
  }

  // Asks the server for the capture's box, which may be newer than the page. A box that is being drawn stays as it is.
  async load() {
    const asked = ++this.questions;
    try {
      const region = await this.viewer.photos.region();
      if (asked !== this.questions) return; // a box was saved here meanwhile, or a later question was answered
      this.saved = region && { ...region, center: plus(region.center, this.viewer.facts.origin, -1) };
      const before = this.stored;
      this.stored = numbersOf(region);
      if (this.drawing && before !== this.stored) this.say(region ? ELSEWHERE.saved : ELSEWHERE.removed);
    } finally {
      this.loaded = true;
      this.changed();
      if (this.wanted) this.draw();
    }
  }

  // Shows the handle at the saved box, or at one around what most photos look at; as soon as the server has said which.
  draw() {
    this.wanted = !this.loaded;
    if (this.wanted) return;
    this.shape = this.saved ?? this.viewer.facts.subject;
    this.drawing = true;
    this.gizmo.chosen = this.gizmo.hover = null;
    this.viewer.choose(-1);
    if (matchMedia(SMALL).matches) this.viewer.panel.folded.hide(true);
    this.viewer.view.orbitAround(this.shape.center);
    this.say("");
    this.changed();
    this.viewer.canvas.focus();
  }

  close() {
    [this.shape, this.stroke, this.drawing] = [null, null, false];
    this.viewer.canvas.style.cursor = "";
    this.changed();
    element(element("tools").hidden ? "fold" : "region-draw").focus();
  }

  async save() {
    const { origin } = this.viewer.facts;
    const region = { ...this.shape, center: plus(this.shape.center, origin) };
    await this.store(region);
    this.saved = this.shape;
    this.close();
    this.say("The box is saved. Trainings learn only what the photos show of it.");
    tellFrame("region", { drawn: true });
  }

  async remove() {
    await this.store(null);
    this.saved = null;
    this.close();
    this.say("The box is removed. Trainings learn all that the photos show.");
    tellFrame("region", { drawn: false });
  }

  // Stores a box in the capture's coordinates; answers to earlier questions do not replace it.
  async store(region) {
    await this.viewer.photos.saveRegion(region);
    this.questions += 1;
    this.stored = numbersOf(region);
  }

  // Says something beside the box's numbers while it is drawn, else beside the button that draws it.
  say(text) {
    for (const [id, is] of [
      ["region-note", this.drawing],
      ["region-said", !this.drawing],
    ])
      element(id).textContent = is ? text : "";
  }

  get perPixel() {
    return this.viewer.dense;
  }

  // Column and row of the picture at CSS pixels of the window.
  pointOf(_camera, x, y) {
    const { left, top } = this.viewer.canvas.getBoundingClientRect();
    return { x, y, u: (x - left) * this.viewer.dense - 0.5, v: (y - top) * this.viewer.dense - 0.5 };
  }

  down(event) {
    const { viewer } = this;
    if (!this.drawing || event.target !== viewer.canvas) return;
    if (this.stroke) {
      this.hand();
      return;
    }
    if (event.button !== 0) return;
    const camera = viewer.camera();
    const at = this.pointOf(camera, event.clientX, event.clientY);
    const stroke = { id: event.pointerId, camera, began: at, at };
    if (!this.gizmo.takes(stroke, event.pointerType)) {
      const handle = sideAt(this.shape, stroke, this.perPixel, viewer.facts.near);
      if (!handle) return; // the drag orbits
      Object.assign(stroke, { handle, box: this.shape });
    }
    this.keep(event);
    viewer.canvas.focus({ preventScroll: true });
    viewer.canvas.setPointerCapture(event.pointerId);
    this.stroke = stroke;
    this.redraw();
  }

  move(event) {
    if (!this.drawing) return;
    const { stroke } = this;
    if (stroke?.id !== event.pointerId) {
      if (!stroke && !event.buttons) this.gizmo.hovers(event);
      return;
    }
    this.keep(event);
    stroke.at = this.pointOf(stroke.camera, event.clientX, event.clientY);
    if (stroke.grip) this.gizmo.drag(stroke);
    else this.gizmo.take(sideDragged(stroke, this.viewer.view.distance) ?? this.shape);
    this.redraw();
  }

  up(event) {
    if (this.stroke?.id !== event.pointerId) return;
    this.keep(event);
    if (event.type === "pointercancel") this.shape = this.began;
    this.stroke = null;
    this.changed();
  }

  // The box when the stroke began.
  get began() {
    return this.stroke.grip?.shape ?? this.stroke.box;
  }

  keep(event) {
    event.preventDefault();
    event.stopPropagation();
  }

  // A second finger: both navigate, and the box is where it was.
  hand() {
    const { id, at } = this.stroke;
    this.shape = this.began;
    this.stroke = null;
    this.viewer.controls.press({
      pointerId: id,
      clientX: at.x,
      clientY: at.y,
      button: 0,
      shiftKey: false,
      preventDefault() {},
    });
    this.changed();
  }

  keyDown(event) {
    if (!this.drawing || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest?.("#region-tools input")) {
      event.stopPropagation(); // what is typed is no command of the page
      return;
    }
    if (event.key === "Escape") this.gizmo.chosen ? this.gizmo.choose(this.gizmo.chosen.name) : this.close();
    else if (!event.key.startsWith("Arrow") || !this.gizmo.chosen) return;
    else if (!this.gizmo.step(event)) return;
    this.keep(event);
  }

  input(field) {
    const value = Number(field.value);
    if (field.value === "" || !Number.isFinite(value)) return;
    for (const name of ["center", "half"]) {
      const index = this[name].indexOf(field);
      if (index < 0 || (name === "half" && value <= 0)) continue;
      this.gizmo.take({ ...this.shape, [name]: this.shape[name].map((old, i) => (i === index ? value : old)) });
    }
    this.redraw();
  }

  // The handle or a number has changed the box.
  shapeMoved() {
    this.show();
  }

  redraw() {
    this.viewer.askFrame();
  }

  changed() {
    element("region-tools").hidden = !this.drawing;
    element("region-draw").hidden = element("cameras").hidden = this.drawing;
    document.body.classList.toggle("drawing", this.drawing);
    element("region-draw").textContent = this.saved ? "Change the box" : "Draw a box";
    element("region-remove").hidden = this.drawing || !this.saved;
    this.show();
    this.redraw();
  }

  // Shows the box's numbers, but not over what is being typed.
  show() {
    this.gizmo.panel.update();
    for (const name of ["center", "half"]) {
      this[name].forEach((field, i) => {
        if (field !== document.activeElement)
          field.value = this.shape ? Number(this.shape[name][i].toPrecision(4)) : "";
      });
    }
  }

  // Draws the box over a picture from a camera.
  paint(camera) {
    const { overlay, shape, saved } = this;
    overlay.begin(camera);
    const box = shape ?? saved;
    if (!box) return;
    overlay.lines(boxLines(box));
    if (!shape) return;
    for (const { point } of boxHandles(shape)) overlay.dot(point);
    this.gizmo.draw(overlay);
  }
}

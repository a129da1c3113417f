// The editor's tools: what pointers and keys in the picture do.

import { pointAt } from "./camera.js";
import { frontOf } from "./edit_front.js";
import { CURSOR_STEP, Gizmo } from "./edit_gizmo.js";
import { depthAtPixel } from "./edit_pixel.js";
import { EditPolygon } from "./edit_polygon.js";
import { plus } from "./vectors.js";
import {
  boxHandles,
  boxLines,
  hundredths,
  LEAST_DRAG,
  length3,
  MOST_STROKE,
  newBox,
  pictureOf,
  sideAt,
  sideDragged,
  sphereLines,
  uprightAxes,
} from "./edit_shapes.js";

const LONG_FRONT = 50000; // splats from which the measure of a visible surface is announced
export const POINTS_OF = { floor: 3, scale: 2, measure: 2 }; // points that a tool takes from the surface
const LEAST_STEP = 2; // CSS pixels between the points of a stroke
const CLICKED_SIZE = 0.15; // of the distance to the pivot: radius of a sphere that was only clicked

export class EditTools {
  constructor(editor) {
    Object.assign(this, { editor, viewer: editor.viewer, tool: "navigate", stroke: null, shape: null, points: [] });
    this.gizmo = new Gizmo(this);
    this.polygon = new EditPolygon(this);
    this.hover = null; // where the brush would paint, or the polygon would go on
    this.cursor = null; // the keyboard's place in the picture, CSS pixels
    this.cursorMoved = false;
    this.space = false; // held: pointers navigate
    this.fingers = new Set();
    this.handed = false; // the fingers navigate until all are lifted
    const listen = (name, method) => addEventListener(name, (event) => method.call(this, event), true);
    listen("pointerdown", this.down); // before the page's own controls
    listen("pointermove", this.move);
    listen("pointerup", this.up);
    listen("pointercancel", this.up);
    listen("keydown", this.keyDown);
    listen("keyup", (event) => {
      if (event.code === "Space") this.space = false;
    });
    addEventListener("blur", () => (this.space = false));
  }

  choose(tool) {
    this.cancel();
    [this.tool, this.shape] = [tool, null];
    this.cursor = this.hover = this.gizmo.chosen = null;
    this.editor.leveller.reset();
    if (tool === "move") this.editor.mover.begin();
    if (tool === "box") this.shape = this.firstBox();
    this.editor.changed();
  }

  firstBox() {
    const { values, history, scene } = this.editor;
    return newBox(values, history.flags, this.viewer.view.up, scene.subject);
  }

  // Forgets what is being drawn; returns whether there was anything.
  cancel() {
    const isMove = this.tool === "move";
    const drawn = this.polygon.drop() || this.stroke || (isMove ? this.editor.mover.moved : this.shape);
    const some = drawn || this.points.length;
    [this.stroke, this.shape, this.points] = [null, null, []];
    if (isMove) this.editor.mover.begin();
    this.editor.redraw();
    return Boolean(some);
  }

  // Column and row of the picture at CSS pixels of the window.
  pointOf(camera, x, y) {
    const { left, top, width, height } = this.viewer.canvas.getBoundingClientRect();
    const u = hundredths(((x - left) / width) * camera.W - 0.5);
    const v = hundredths(((y - top) / height) * camera.H - 0.5);
    return { x, y, u, v };
  }

  get perPixel() {
    return this.viewer.camera().W / this.viewer.canvas.getBoundingClientRect().width;
  }

  down(event) {
    if (event.target !== this.viewer.canvas) return;
    this.fingers.add(event.pointerId);
    if (this.tool === "navigate" || this.space || event.button !== 0 || this.handed) return;
    if (this.stroke) {
      this.hand();
      return;
    }
    this.take(event);
    this.cursor = null;
    this.viewer.canvas.focus({ preventScroll: true });
    this.press(event.pointerId, event.clientX, event.clientY, event.pointerType);
  }

  move(event) {
    if (this.stroke?.id === event.pointerId) {
      this.take(event);
      this.drag(event.clientX, event.clientY);
    } else if ((this.tool === "brush" || this.tool === "polygon") && event.target === this.viewer.canvas) {
      this.hover = this.pointOf(this.viewer.camera(), event.clientX, event.clientY);
      this.editor.redraw();
    } else if (this.shape) this.gizmo.hovers(event);
  }

  // The handle or a number has changed the shape.
  shapeMoved() {
    if (this.tool === "move") this.editor.mover.preview(this.shape);
    this.editor.panel.showShape();
  }

  up(event) {
    this.fingers.delete(event.pointerId);
    if (!this.fingers.size) this.handed = false;
    if (this.stroke?.id !== event.pointerId) return;
    this.take(event);
    if (event.type === "pointercancel") this.cancel();
    else this.release(this.howOf(event));
  }

  take(event) {
    event.preventDefault();
    event.stopPropagation();
  }

  // A second finger: both navigate, and what the first one drew is dropped.
  hand() {
    const { id, at, grip } = this.stroke;
    if (grip) this.gizmo.take(grip.shape);
    this.stroke = null;
    this.handed = true;
    const first = { pointerId: id, clientX: at.x, clientY: at.y, button: 0, shiftKey: false, preventDefault() {} };
    this.viewer.controls.press(first);
    this.editor.redraw();
  }

  // How a selection combines with the one before: as chosen in the panel, or by the keys that are held.
  howOf({ shiftKey, ctrlKey, metaKey }) {
    const control = ctrlKey || metaKey;
    if (shiftKey) return control ? "intersect" : "add";
    return control ? "subtract" : this.editor.how;
  }

  press(id, x, y, pointerType) {
    this.viewer.stop();
    const camera = this.viewer.camera();
    const at = this.pointOf(camera, x, y);
    this.stroke = { id, camera, began: at, at, points: [[at.u, at.v]] };
    if (!this.gizmo.takes(this.stroke, pointerType)) this[`${this.tool}Begins`]?.(this.stroke);
    this.editor.redraw();
  }

  drag(x, y) {
    const { stroke } = this;
    const last = stroke.lastKept ?? stroke.began;
    stroke.at = this.pointOf(stroke.camera, x, y);
    if (Math.hypot(x - last.x, y - last.y) >= LEAST_STEP && stroke.points.length < MOST_STROKE) {
      stroke.points.push([stroke.at.u, stroke.at.v]);
      stroke.lastKept = stroke.at;
    }
    if (stroke.grip) this.gizmo.drag(stroke);
    else this[`${this.tool}Drags`]?.(stroke);
    this.editor.redraw();
  }

  release(how) {
    const { stroke } = this;
    this.stroke = null;
    if (!stroke.grip) this[`${this.tool}Ends`]?.(stroke, how);
    else if (this.tool === "move") this.editor.mover.perform();
    this.editor.changed();
  }

  wasClick({ began, at }) {
    return Math.hypot(at.x - began.x, at.y - began.y) < LEAST_DRAG;
  }

  // Selects by a shape in the picture of a camera. Where it may take seconds to measure the visible surface, the panel
  // says so first.
  select(how, region, camera) {
    const { editor } = this;
    const perform = (front) => editor.perform({ op: "select", how, ...region, ...front });
    if (!editor.frontOnly) return perform({});
    if (editor.values.count < LONG_FRONT) return perform({ front: this.frontOf(region, camera) });
    editor.say("Measuring the visible surface ...");
    // after the browser has painted the line
    return requestAnimationFrame(() => setTimeout(() => perform({ front: this.frontOf(region, camera) })));
  }

  frontOf(region, camera) {
    const { settings, facts } = this.viewer;
    const { values, history } = this.editor;
    return frontOf(region, camera, { values, flags: history.flags, settings, near: facts.near }, this.perPixel);
  }

  rectangleEnds(stroke, how) {
    if (this.wasClick(stroke)) return;
    const { began: a, at: b } = stroke;
    const corners = [Math.min(a.u, b.u), Math.min(a.v, b.v), Math.max(a.u, b.u), Math.max(a.v, b.v)];
    this.select(how, { by: "rectangle", camera: pictureOf(stroke.camera), corners }, stroke.camera);
  }

  lassoEnds({ camera, points }, how) {
    if (points.length > 2) this.select(how, { by: "lasso", camera: pictureOf(camera), points }, camera);
  }

  polygonEnds(stroke, how) {
    this.polygon.click(stroke, how);
  }

  brushEnds({ camera, points }, how) {
    const radius = hundredths(this.editor.radius * this.perPixel);
    this.select(how, { by: "brush", camera: pictureOf(camera), radius, points }, camera);
  }

  // The surface at a point of the picture; null where there is none. Points to measure lie on the page's mesh, where it
  // has one.
  surface({ camera, at: { u, v } }) {
    const onMesh = this.tool in POINTS_OF ? (this.viewer.meshes?.depthAt(camera, u, v) ?? null) : null;
    if (onMesh !== null) {
      this.editor.say("");
      return { point: pointAt(camera, u, v, onMesh), depth: onMesh };
    }
    const [column, row] = [Math.round(u), Math.round(v)].map((x, i) =>
      Math.min(Math.max(x, 0), [camera.W, camera.H][i] - 1),
    );
    const depth = this.depthAt(camera, column, row);
    this.editor.say(depth === null ? "There is nothing at that point; choose one on the scene." : "");
    return depth === null ? null : { point: pointAt(camera, u, v, depth), depth };
  }

  depthAt(camera, column, row) {
    const { settings, facts } = this.viewer;
    const { values, history } = this.editor;
    return depthAtPixel(values, history.flags, camera, settings, column, row, facts.near);
  }

  sphereBegins(stroke) {
    stroke.found = this.surface(stroke);
    if (stroke.found) this.shape = { center: stroke.found.point, radius: CLICKED_SIZE * this.viewer.view.distance };
  }

  sphereDrags(stroke) {
    const { found, began, at, camera } = stroke;
    if (!found || this.wasClick(stroke)) return;
    this.shape.radius = (Math.hypot(at.u - began.u, at.v - began.v) * found.depth) / camera.fx;
  }

  boxBegins(stroke) {
    const side = this.shape && sideAt(this.shape, stroke, this.perPixel, this.viewer.facts.near);
    if (side) {
      [stroke.handle, stroke.box] = [side, this.shape];
      return;
    }
    stroke.found = this.surface(stroke);
    if (!stroke.found) return;
    const size = CLICKED_SIZE * this.viewer.view.distance;
    this.shape = { center: stroke.found.point, rotation: uprightAxes(this.viewer.view.up), half: [size, size, size] };
  }

  boxDrags(stroke) {
    const { found, began, at, camera } = stroke;
    if (stroke.handle) this.shape = sideDragged(stroke, this.viewer.view.distance) ?? this.shape;
    else if (found && !this.wasClick(stroke)) {
      const size = (Math.hypot(at.u - began.u, at.v - began.v) * found.depth) / camera.fx;
      this.shape.half = [size, size, size];
    }
  }

  colorEnds({ camera, at }) {
    const color = this.editor.pictureColor(camera, Math.round(at.u), Math.round(at.v));
    this.editor.panel.showColor(color);
  }

  pointEnds(stroke) {
    const found = this.surface(stroke);
    if (!found) return;
    if (this.points.length >= POINTS_OF[this.tool]) this.points = [];
    this.points.push(found.point);
  }

  floorEnds(stroke) {
    this.pointEnds(stroke);
    if (this.points.length === 3) this.editor.level(this.points, stroke.camera.eye) && (this.points = []);
  }

  scaleEnds(stroke) {
    this.pointEnds(stroke);
  }

  measureEnds(stroke) {
    this.pointEnds(stroke);
  }

  // The length between two chosen points; null before.
  get apart() {
    return this.points.length === 2 && this.tool !== "floor" ? length3(plus(...this.points, -1)) : null;
  }

  draw(overlay) {
    const { stroke, shape, tool, points, editor } = this;
    const radius = editor.radius * this.perPixel;
    if (tool === "sphere" && shape) {
      overlay.lines(sphereLines(shape, this.viewer.view.camera.R));
      overlay.dot(shape.center);
    }
    if (tool === "box" && shape) {
      overlay.lines(boxLines(shape));
      for (const { point } of boxHandles(shape)) overlay.dot(point);
    }
    if (tool === "move" && shape) overlay.lines(boxLines(shape), "#ffd24a", true);
    this.gizmo.draw(overlay);
    points.forEach((point, i) => overlay.dot(point, String(i + 1)));
    if (this.apart !== null) overlay.lines([points]);
    if (stroke && tool === "rectangle") {
      const { began: a, at: b } = stroke;
      overlay.polyline([a, { u: b.u, v: a.v }, b, { u: a.u, v: b.v }], true);
    }
    if (stroke && tool === "lasso")
      overlay.polyline(
        [...stroke.points, [stroke.at.u, stroke.at.v]].map(([u, v]) => ({ u, v })),
        true,
      );
    if (stroke && tool === "brush")
      overlay.band(
        stroke.points.map(([u, v]) => ({ u, v })),
        radius,
      );
    this.polygon.draw(overlay);
    if (tool === "brush" && (stroke?.at || this.hover)) overlay.circle(stroke?.at ?? this.hover, radius);
    if (this.cursor) {
      const at = this.pointOf(overlay.camera, this.cursor.x, this.cursor.y);
      const arm = 12 * this.perPixel;
      for (const [du, dv] of [
        [arm, 0],
        [0, arm],
      ]) {
        overlay.polyline(
          [
            { u: at.u - du, v: at.v - dv },
            { u: at.u + du, v: at.v + dv },
          ],
          false,
          "#fff",
        );
      }
    }
  }

  keyDown(event) {
    const { target, key, code } = event;
    const types = target.closest?.("input, textarea, select");
    if (types || event.altKey) return;
    if (event.ctrlKey || event.metaKey) {
      const undone = { z: event.shiftKey ? "redo" : "undo", y: "redo", s: "store", k: "find" }[key.toLowerCase()];
      if (!undone) return;
      this.take(event);
      this.editor[undone]();
      return;
    }
    if (key.startsWith("Arrow") && target.closest?.("#strip")) return; // they move a view, or the playhead
    const onButton = target.closest?.("button, summary, a");
    if (code === "Space" && !onButton) this.space = true;
    else if (key.startsWith("Arrow") && this.tool !== "navigate" && (!onButton || this.gizmo.chosen))
      this.moveCursor(event);
    else if (key === "Enter" && !onButton && this.tool !== "navigate") this.enter(event);
    else if (key === "Escape") this.escape();
    else if (key === "Backspace" && this.polygon.back()) this.cursorMoved = true;
    else if (!this.editor.panel.pressKey(event.shiftKey ? `Shift+${key.toLowerCase()}` : key.toLowerCase())) return;
    this.take(event);
  }

  escape() {
    if (this.viewer.guide.on) return this.viewer.dismiss();
    if (!this.cancel() && !this.cursor) this.choose("navigate");
    this.cursor = null;
    return this.editor.changed();
  }

  moveCursor(event) {
    if (this.gizmo.step(event)) return;
    const { key, shiftKey } = event;
    const { left, top, width, height } = this.viewer.canvas.getBoundingClientRect();
    const step = shiftKey ? 1 : CURSOR_STEP;
    const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key];
    const { x, y } = this.cursor ?? { x: left + width / 2, y: top + height / 2 };
    const within = (value, low, size) => Math.min(Math.max(value, low), low + size - 1);
    this.cursor = { x: within(x + dx * step, left, width), y: within(y + dy * step, top, height) };
    this.cursorMoved = true;
    if (this.stroke) this.drag(this.cursor.x, this.cursor.y);
    this.editor.redraw();
  }

  // Presses at the cursor, releases, or applies what was chosen.
  enter(event) {
    if (this.polygon.enter(event)) return;
    if (this.stroke) {
      this.cursorMoved = false;
      this.release(this.howOf(event));
    } else if (this.cursor && (this.cursorMoved || !this.editor.panel.ready)) {
      this.press("keyboard", this.cursor.x, this.cursor.y);
    } else this.editor.panel.apply();
  }
}

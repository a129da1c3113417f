// The handle in the picture: three arrows, three rings and a middle, which move and turn a box, a sphere or the selection.
//
// What it moves is the shape of the tool: {center, rotation, ...} with the columns of `rotation` as axes. A sphere has no
// rotation, so its handle has no rings.

import { pointAt } from "./camera.js";
import { GIZMO_PARTS, GizmoPanel } from "./edit_gizmo_panel.js";
import { turnedRows } from "./edit_rotations.js";
import { boxHandles, CIRCLE, HANDLE, seenAt, seenLine, uprightAxes } from "./edit_shapes.js";
import { cross, dot, plus, radians, transposed, unit } from "./vectors.js";

const [GIZMO_ARROW, GIZMO_RING, GIZMO_MIDDLE] = [88, 64, 9]; // CSS pixels: an arrow's length, the radii of rings and middle
const GIZMO_REACH = { mouse: 9, pen: 12, touch: 22 }; // CSS pixels within which a pointer takes hold of a part
const GIZMO_COLORS = ["#ff7a7a", "#7be08a", "#7ab8ff"];
const GIZMO_HELD = "#fff";
const GIZMO_LEAST = 12; // CSS pixels: an arrow that is seen shorter, along the line of sight, is left out
const EDGE_ON = 0.2; // cosine of the angle between line of sight and a ring's axis below which the ring is seen as a line
export const CURSOR_STEP = 8; // CSS pixels per key; 1 with Shift
const [TURN_STEP, TURN_FINE] = [5, 0.5]; // degrees per key

// How far along the line through `point` with a direction of length 1 a ray passes closest; null if they are parallel.
function alongLine(point, direction, eye, ray) {
  const away = plus(point, eye, -1);
  const cosine = dot(direction, ray);
  const sine2 = 1 - cosine * cosine;
  return sine2 < 1e-6 ? null : (cosine * dot(ray, away) - dot(direction, away)) / sine2;
}

// From the centre to where a ray meets the plane through it; null if it does not, in front of the eye.
function onPlane(center, normal, eye, ray) {
  const length = dot(normal, plus(center, eye, -1)) / dot(normal, ray);
  return length > 0 && Number.isFinite(length) ? plus(plus(eye, ray, length), center, -1) : null;
}

export class Gizmo {
  constructor(tools) {
    Object.assign(this, { tools, viewer: tools.viewer, hover: null, chosen: null });
    this.panel = new GizmoPanel(this);
  }

  get shape() {
    return this.tools.shape;
  }

  get editor() {
    return this.tools.editor;
  }

  // The upright rotation, whose columns are the axes of all but a box.
  get upright() {
    return uprightAxes(this.viewer.view.up);
  }

  axes() {
    return transposed(this.tools.tool === "box" ? this.shape.rotation : this.upright);
  }

  parts() {
    return this.shape?.rotation ? GIZMO_PARTS : GIZMO_PARTS.filter(({ kind }) => kind !== "ring");
  }

  // World units per CSS pixel at the centre; null if it is not in front of the camera.
  scale(camera) {
    if (!this.shape) return null;
    const { depth } = seenAt(camera, this.shape.center);
    return depth > this.viewer.facts.near ? (this.tools.perPixel * depth) / camera.fx : null;
  }

  // The lines of a part in the world: an arrow, or the half of a ring that faces the camera.
  lines({ kind, axis }, camera, scale) {
    const axes = this.axes();
    const { center } = this.shape;
    if (kind === "arrow") {
      const end = plus(center, axes[axis], GIZMO_ARROW * scale);
      const [a, b] = [center, end].map((point) => seenAt(camera, point));
      return Math.hypot(a.u - b.u, a.v - b.v) < GIZMO_LEAST * this.tools.perPixel ? [] : [[center, end]];
    }
    if (kind === "middle") return [];
    const [p, q] = [axes[(axis + 1) % 3], axes[(axis + 2) % 3]];
    const sight = unit(plus(center, camera.eye, -1));
    const faces = Math.abs(dot(sight, axes[axis])) > 0.98; // then all of it is at the same depth
    const offset = (i) => {
      const angle = (2 * Math.PI * i) / CIRCLE;
      return plus(
        p.map((x) => x * Math.cos(angle)),
        q,
        Math.sin(angle),
      );
    };
    return Array.from({ length: CIRCLE }, (_, i) => [offset(i), offset(i + 1)])
      .filter(([a, b]) => faces || dot(sight, plus(a, b)) < 0.1)
      .map((ends) => ends.map((end) => plus(center, end, GIZMO_RING * scale)));
  }

  // The part at a place of the picture, within so many CSS pixels; null if there is none, or a dot on a box's side.
  partAt(camera, at, reach) {
    const scale = this.scale(camera);
    if (scale === null) return null;
    const { perPixel } = this.tools;
    const far = ({ u, v }) => Math.hypot(u - at.u, v - at.v) / perPixel;
    const middle = far(seenAt(camera, this.shape.center));
    if (middle < Math.max(GIZMO_MIDDLE, reach)) return { ...GIZMO_PARTS.at(-1), apart: middle };
    if (this.tools.tool === "box" && boxHandles(this.shape).some(({ point }) => far(seenAt(camera, point)) < HANDLE))
      return null;
    let best = null;
    for (const part of this.parts()) {
      for (const [a, b] of this.lines(part, camera, scale)) {
        const seen = seenLine(camera, a, b, this.viewer.facts.near);
        const apart = seen ? apartFrom(at, ...seen) / perPixel : Infinity;
        if (apart < (best?.apart ?? reach)) best = { ...part, apart, grabbed: a };
      }
    }
    return best;
  }

  // Takes hold of the part where a stroke begins; returns whether there is one.
  takes(stroke, pointerType) {
    const part = this.partAt(stroke.camera, stroke.began, GIZMO_REACH[pointerType] ?? GIZMO_REACH.mouse);
    if (!part) return false;
    stroke.grip = { part, shape: this.shape, axes: this.axes() };
    this.hover = part;
    return true;
  }

  // Moves or turns the shape as it was when the stroke began.
  drag({ grip, camera, began, at }) {
    const { part, shape, axes } = grip;
    const axis = axes[part.axis];
    const ray = ({ u, v }) => unit(plus(pointAt(camera, u, v, 1), camera.eye, -1));
    if (part.kind === "ring") {
      const angle = this.angle(grip, camera, began, at, ray);
      if (Number.isFinite(angle)) this.take(this.turnedShape(shape, axis, angle));
      return;
    }
    if (part.kind === "middle") {
      const { depth } = seenAt(camera, shape.center);
      const [from, to] = [began, at].map(({ u, v }) => pointAt(camera, u, v, depth));
      this.take({ ...shape, center: plus(shape.center, plus(to, from, -1)) });
      return;
    }
    const [from, to] = [began, at].map((place) => alongLine(shape.center, axis, camera.eye, ray(place)));
    const center = from === null || to === null ? null : plus(shape.center, axis, to - from);
    if (center && seenAt(camera, center).depth > this.viewer.facts.near) this.take({ ...shape, center });
  }

  // By how much the pointer has gone around the axis. A ring seen as a line turns by the way along it.
  angle({ part, shape, axes }, camera, began, at, ray) {
    const axis = axes[part.axis];
    const sight = unit(plus(shape.center, camera.eye, -1));
    if (Math.abs(dot(sight, axis)) >= EDGE_ON) {
      const [from, to] = [began, at].map((place) => onPlane(shape.center, axis, camera.eye, ray(place)));
      return from && to ? Math.atan2(dot(axis, cross(from, to)), dot(from, to)) : NaN;
    }
    const tangent = cross(axis, plus(part.grabbed, shape.center, -1)); // of the way per radian
    const [a, b] = [part.grabbed, plus(part.grabbed, tangent, 1e-3)].map((point) => seenAt(camera, point));
    const [du, dv] = [(b.u - a.u) / 1e-3, (b.v - a.v) / 1e-3];
    return ((at.u - began.u) * du + (at.v - began.v) * dv) / (du * du + dv * dv);
  }

  turnedShape(shape, axis, angle) {
    return { ...shape, rotation: turnedRows(shape.rotation, axis, angle) };
  }

  take(shape) {
    this.tools.shape = shape;
    this.tools.shapeMoved();
  }

  // Shows what a pointer would take hold of.
  hovers({ clientX, clientY, target, pointerType }) {
    const { canvas } = this.viewer;
    const camera = this.viewer.camera();
    const place = this.tools.pointOf(camera, clientX, clientY);
    const part = target === canvas && pointerType !== "touch" ? this.partAt(camera, place, GIZMO_REACH.mouse) : null;
    canvas.style.cursor = part ? "grab" : "";
    if (part?.name === this.hover?.name) return;
    this.hover = part;
    this.editor.redraw();
  }

  choose(name) {
    const part = this.parts().find((one) => one.name === name) ?? null;
    this.chosen = part?.name === this.chosen?.name ? null : part;
    this.editor.changed();
  }

  // Chooses the part after the chosen one, and none after the last; returns whether there is a handle.
  chooseNext() {
    if (!this.shape) return false;
    const names = this.parts().map(({ name }) => name);
    const next = names[names.indexOf(this.chosen?.name) + 1];
    this.chosen = this.parts().find(({ name }) => name === next) ?? null;
    this.editor.changed();
    return true;
  }

  // Moves or turns by a key with the chosen part; returns whether it did.
  step({ key, shiftKey }) {
    const camera = this.viewer.camera();
    const scale = this.scale(camera);
    const part = this.parts().find(({ name }) => name === this.chosen?.name);
    if (scale === null || !part || this.tools.stroke) return false;
    const [right, down] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[key];
    const axis = this.axes()[part.axis];
    const length = (shiftKey ? 1 : CURSOR_STEP) * scale;
    const { shape } = this;
    if (part.kind === "ring") {
      const angle = radians(shiftKey ? TURN_FINE : TURN_STEP);
      this.take(this.turnedShape(shape, axis, (right - down) * angle));
    } else if (part.kind === "arrow")
      this.take({ ...shape, center: plus(shape.center, axis, (right - down) * length) });
    else
      this.take({
        ...shape,
        center: plus(plus(shape.center, camera.R[0], right * length), camera.R[1], down * length),
      });
    this.editor.changed();
    return true;
  }

  draw(overlay) {
    const scale = this.scale(overlay.camera);
    if (scale === null) return;
    const lit = this.hover?.name ?? this.chosen?.name;
    for (const part of this.parts()) {
      const color = part.name === lit || part.name === this.chosen?.name ? GIZMO_HELD : GIZMO_COLORS[part.axis];
      const lines = this.lines(part, overlay.camera, scale);
      if (part.kind === "middle")
        overlay.circle(
          seenAt(overlay.camera, this.shape.center),
          GIZMO_MIDDLE * this.tools.perPixel,
          part.name === lit ? GIZMO_HELD : "#ffd24a",
        );
      else if (lines.length) overlay.lines(lines, color);
      if (part.kind === "arrow" && lines.length) overlay.dot(lines[0][1], part.name.at(-1), color);
    }
  }
}

// Pixels from a place to the part of a line between two pixels.
function apartFrom({ u, v }, a, b) {
  const [du, dv] = [b.u - a.u, b.v - a.v];
  const length2 = du * du + dv * dv;
  const share = length2 ? Math.min(Math.max(((u - a.u) * du + (v - a.v) * dv) / length2, 0), 1) : 0;
  return Math.hypot(u - a.u - share * du, v - a.v - share * dv);
}

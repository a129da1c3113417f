// Moves and turns the selected splats: their state, as gsplat_edu/edits/moves.py computes it, and how the page draws it.

import { element, nearestTexture } from "./common.js";
import { SELECTED } from "./edit_flags.js";
import { product3 } from "./edit_rotations.js";
import { dot, plus } from "./vectors.js";

const EYE3 = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];
const TURNS_ACROSS = 256; // rotations in a row of their texture

// The centres and rotations of splats after the operations "move". Means change in place, in the order that docs/EDITS.md
// states, so that later selections see the same numbers as the command. Rotations are only drawn; splats that were moved
// together share one.
export class Motion {
  constructor({ count, means }) {
    this.means = means;
    this.opened = means.slice();
    this.turned = new Uint32Array(count); // index of each splat's rotation in `turns`
    this.turns = [EYE3];
    this.steps = [[]]; // for each of `turns`, the moves {R, t} that its splats have had, in order
    this.stale = null; // [first, last] of the splats that are drawn where they were before
  }

  // Moves the selected splats; returns what undoes it.
  apply({ rotation, translation: [tx, ty, tz], center: [cx, cy, cz] }, flags) {
    const at = placesOf(flags, SELECTED);
    const { means, turned } = this;
    const record = {
      at,
      means: new Float32Array(3 * at.length),
      turned: new Uint32Array(at.length),
      turns: this.turns.length,
    };
    record.bytes = 20 * at.length;
    const step = {
      R: rotation,
      t: [0, 1, 2].map((i) => [cx, cy, cz][i] + [tx, ty, tz][i] - dot(rotation[i], [cx, cy, cz])),
    };
    const [[r00, r01, r02], [r10, r11, r12], [r20, r21, r22]] = rotation;
    const next = new Map(); // indices of the rotations after this turn, by those before
    at.forEach((i, j) => {
      const k = 3 * i;
      record.means.set(means.subarray(k, k + 3), 3 * j);
      record.turned[j] = turned[i];
      const [a, b, c] = [means[k] - cx, means[k + 1] - cy, means[k + 2] - cz];
      means[k] = r00 * a + r01 * b + r02 * c + cx + tx;
      means[k + 1] = r10 * a + r11 * b + r12 * c + cy + ty;
      means[k + 2] = r20 * a + r21 * b + r22 * c + cz + tz;
      if (!next.has(turned[i])) {
        next.set(turned[i], this.turns.push(product3(rotation, this.turns[turned[i]])) - 1);
        this.steps.push([...this.steps[turned[i]], step]);
      }
      turned[i] = next.get(turned[i]);
    });
    this.touch(at);
    return record;
  }

  undo({ at, means, turned, turns }) {
    at.forEach((i, j) => {
      this.means.set(means.subarray(3 * j, 3 * j + 3), 3 * i);
      this.turned[i] = turned[j];
    });
    this.turns.length = this.steps.length = turns;
    this.touch(at);
  }

  // Back to the opened scene.
  reset() {
    this.means.set(this.opened);
    this.turned.fill(0);
    this.turns = [EYE3];
    this.steps = [[]];
    if (this.turned.length) this.stale = [0, this.turned.length - 1];
  }

  touch(at) {
    if (!at.length) return;
    const [first, last] = this.stale ?? [Infinity, -1];
    this.stale = [Math.min(first, at[0]), Math.max(last, at.at(-1))];
  }
}

// A move {R, t} after another one.
const movedBy = (done, { R, t }) => ({ R: product3(R, done.R), t: [0, 1, 2].map((i) => dot(R[i], done.t) + t[i]) });

// What the moves of all splats that are left do together, {R, t}; and whether there were moves of some of them only. As
// gsplat_edu/edits/apply.py computes it.
export function movedTogether({ motion }, flags) {
  const left = new Set();
  if (motion) for (let i = 0; i < flags.length; ++i) if (flags[i] <= SELECTED) left.add(motion.turned[i]);
  const [first = [], ...others] = [...left].map((index) => motion.steps[index]);
  const sets = others.map((steps) => new Set(steps));
  const shared = first.filter((step) => sets.every((steps) => steps.has(step)));
  const whole = shared.reduce(movedBy, { R: EYE3, t: [0, 0, 0] });
  return { whole, some: [first, ...others].some(({ length }) => length > shared.length) };
}

// The indices of all splats in a state.
function placesOf(flags, state) {
  let count = 0;
  for (let i = 0; i < flags.length; ++i) if (flags[i] === state) ++count;
  const at = new Uint32Array(count);
  for (let i = 0, j = 0; j < count; ++i) if (flags[i] === state) at[j++] = i;
  return at;
}

// The rotation of a splat since the scene was opened.
export function turnSince({ motion }, i) {
  return motion ? motion.turns[motion.turned[i]] : EYE3;
}

// What the shader reads about moved splats: which rotation each has, the rotations, and the move under the pointer.
export class MotionTextures {
  constructor(renderer) {
    const { gl, textures, textureWidth, facts } = renderer;
    Object.assign(this, { renderer, live: null, any: false, units: [textures.length + 3, textures.length + 4] }); // behind seen.js
    this.height = Math.max(1, Math.ceil(facts.count / textureWidth));
    this.textures = [];
    this.gl = gl;
  }

  make() {
    const { gl } = this;
    this.textures = this.units.map((unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      return nearestTexture(gl);
    });
    gl.activeTexture(gl.TEXTURE0 + this.units[0]);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, this.renderer.textureWidth, this.height);
  }

  // Copies rows of a texture that hold the splats from `first` to `last`.
  rows(texture, unit, values, channels, [first, last], format, type) {
    const { gl } = this;
    const width = this.renderer.textureWidth;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    for (let row = Math.floor(first / width); row * width <= last; ++row) {
      const part = values.subarray(channels * row * width, channels * (row + 1) * width);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, part.length / channels, 1, format, type, part);
    }
  }

  write({ means, turned, turns }, range) {
    const { gl } = this;
    if (!this.textures.length) this.make();
    this.rows(this.renderer.textures[0], 0, means, 3, range, gl.RGB, gl.FLOAT);
    this.rows(this.textures[0], this.units[0], turned, 1, range, gl.RED_INTEGER, gl.UNSIGNED_INT);
    const down = Math.ceil(turns.length / TURNS_ACROSS);
    const texels = new Float32Array(9 * TURNS_ACROSS * down);
    turns.forEach((rows, i) => texels.set(rows.flat(), 9 * i));
    gl.activeTexture(gl.TEXTURE0 + this.units[1]);
    gl.bindTexture(gl.TEXTURE_2D, this.textures[1]);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB32F, 3 * TURNS_ACROSS, down, 0, gl.RGB, gl.FLOAT, texels);
    this.any = turns.length > 1;
  }

  bind(flags) {
    const { gl, any, live } = this;
    const place = (name) => gl.getUniformLocation(this.renderer.program, name);
    // without a texture of their own, the samplers share one of their type
    const units = this.textures.length ? this.units : [flags.unit, 0];
    this.textures.forEach((texture, i) => {
      gl.activeTexture(gl.TEXTURE0 + units[i]);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.uniform1i(place("turned"), units[0]);
    gl.uniform1i(place("turns"), units[1]);
    gl.uniform1i(place("turns_across"), any ? TURNS_ACROSS : 0);
    gl.uniform1i(place("moving"), live ? 1 : 0);
    if (!live) return;
    gl.uniformMatrix3fv(place("moving_turn"), true, live.rotation.flat());
    gl.uniform3fv(place("moving_from"), live.from);
    gl.uniform3fv(place("moving_to"), live.center);
  }
}

// A box around the selected splats, as the handle moves it: `from` is its centre before. Null if there are none.
function selectedBox({ count, means }, flags) {
  const [low, high] = [
    [Infinity, Infinity, Infinity],
    [-Infinity, -Infinity, -Infinity],
  ];
  for (let i = 0; i < count; ++i) {
    if (flags[i] !== SELECTED) continue;
    const mean = [means[3 * i], means[3 * i + 1], means[3 * i + 2]];
    if (!mean.every(Number.isFinite)) continue;
    for (let j = 0; j < 3; ++j) [low[j], high[j]] = [Math.min(low[j], mean[j]), Math.max(high[j], mean[j])];
  }
  if (!(low[0] <= high[0])) return null;
  const center = low.map((x, j) => (x + high[j]) / 2);
  return { center, from: center, rotation: EYE3, half: low.map((x, j) => Math.max((high[j] - x) / 2, 1e-6)) };
}

// Where the handle takes what is at its place before, {R, t}.
const moveOf = ({ rotation: R, from, center }) => ({ R, t: [0, 1, 2].map((i) => center[i] - dot(R[i], from)) });

// The tool that moves the selection; the splats, and the mesh with all of them, follow the handle while it is dragged, in their order before the move.
export class Mover {
  constructor(editor) {
    this.editor = editor;
    const { renderer } = editor.viewer;
    this.textures = renderer.motion ??= new MotionTextures(renderer);
    this.by = editor.panel.addNumbers("edit-by");
    element("edit-by").addEventListener("input", ({ target }) => this.input(target));
  }

  // The selection or the splats have changed.
  follow() {
    const { tools, values, viewer } = this.editor;
    const { motion } = values;
    if (motion?.stale) {
      const [first, last] = motion.stale;
      this.textures.write(motion, motion.stale);
      viewer.sorter.write(motion.means.slice(3 * first, 3 * (last + 1)), first);
      motion.stale = null;
    }
    if (tools.tool === "move") this.begin();
  }

  // The handle at the middle of the selection.
  begin() {
    const { tools, values, history } = this.editor;
    tools.shape = selectedBox(values, history.flags);
    this.preview(null);
  }

  // Draws the selected splats where the handle has taken them; null for where they are.
  preview(shape) {
    if (this.textures.live === shape) return;
    this.textures.live = shape;
    this.placeMesh();
    this.editor.viewer.refresh();
  }

  // Brings the page's mesh to where the splats are drawn. It follows the handle while all that are left are selected.
  placeMesh() {
    const { viewer, history, together } = this.editor;
    if (!viewer.meshes || !together) return;
    const { live } = this.textures;
    const follows = live && !history.flags.includes(0);
    viewer.meshes.place(follows ? movedBy(together.whole, moveOf(live)) : together.whole, together.some);
  }

  // Whether the handle is elsewhere than the selection.
  get moved() {
    const { shape, tool } = this.editor.tools;
    return tool === "move" && shape !== null && (shape.center !== shape.from || shape.rotation !== EYE3);
  }

  perform() {
    if (!this.moved) return;
    const { rotation, center, from } = this.editor.tools.shape;
    this.editor.perform({ op: "move", rotation, translation: plus(center, from, -1), center: from });
  }

  // Takes a number of the translation that was typed.
  input(field) {
    const { tools } = this.editor;
    const [index, value] = [this.by.indexOf(field), Number(field.value)];
    const { shape } = tools;
    if (!shape || field.value === "" || !(Math.abs(value) < 1e30)) return;
    tools.gizmo.take({ ...shape, center: shape.center.map((x, i) => (i === index ? shape.from[i] + value : x)) });
    this.editor.changed();
  }

  update() {
    const { shape, tool } = this.editor.tools;
    const by = tool === "move" && shape ? plus(shape.center, shape.from, -1) : [];
    this.by.forEach((input, i) => {
      if (input !== document.activeElement) input.value = by.length ? Number(by[i].toPrecision(4)) : "";
    });
    this.editor.panel.button("move").disabled = !this.moved;
  }
}

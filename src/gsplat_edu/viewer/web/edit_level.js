// Levels the scene by the directions of its cameras: people hold cameras level, so the images' x axes are horizontal.

import { element } from "./common.js";
import { degrees } from "./edit_rotations.js";
import { EDIT_UP, normalOf, rotated } from "./edit_shapes.js";
import { cross, dot, plus, transposed, turned, unit } from "./vectors.js";

const LEAST_CAMERAS = 3;
const LEAST_SPREAD = 0.1; // root mean square of the x axes' second coordinate: 6 degrees from one common direction
const USUAL_ROLL = (1 * Math.PI) / 180; // of a camera in the hand; fewer images cannot prove that theirs is smaller
const MOST_ERROR = (3 * Math.PI) / 180; // standard error of the up direction
const LEAST_UP = 0.1; // mean of cos(angle between up and an image's up direction): 84 degrees
const LEAST_AGREEING = 0.8; // sum of these cosines, in that of their absolute values

// Eigenvalues of a symmetric matrix, smallest first, with unit eigenvectors: [{value, vector}], by Jacobi's rotations.
export function eigenvectors(matrix) {
  const A = matrix.map((row) => [...row]);
  const V = [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ]; // its columns become the eigenvectors
  for (let sweep = 0; sweep < 30; ++sweep) {
    for (const [p, q] of [
      [0, 1],
      [0, 2],
      [1, 2],
    ]) {
      if (A[p][q] === 0) continue;
      const angle = 0.5 * Math.atan2(2 * A[p][q], A[q][q] - A[p][p]);
      const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
      const mix = (a, b) => [cos * a - sin * b, sin * a + cos * b];
      for (let k = 0; k < 3; ++k) [A[k][p], A[k][q]] = mix(A[k][p], A[k][q]);
      for (let k = 0; k < 3; ++k) [A[p][k], A[q][k]] = mix(A[p][k], A[q][k]);
      for (let k = 0; k < 3; ++k) [V[k][p], V[k][q]] = mix(V[k][p], V[k][q]);
      A[p][q] = A[q][p] = 0;
    }
  }
  return [0, 1, 2].map((i) => ({ value: A[i][i], vector: V.map((row) => row[i]) })).sort((a, b) => a.value - b.value);
}

// The up direction of cameras {R}, as {up, error, count} with the standard error in radians, or {refused} with the reason.
//
// With r the x axes, up minimises the mean of (up . r)^2: it is the eigenvector of A = mean of r r' with the smallest
// eigenvalue. Its error lies mainly along the second eigenvector. To first order it is the mean of (up . r) (second . r),
// divided by l1 - l0; for independent rolls its standard deviation is sqrt(l0 l1 / n) / (l1 - l0).
export function upOfCameras(cameras) {
  const count = cameras.length;
  if (count < LEAST_CAMERAS)
    return {
      refused: `The scene has ${count} cameras; at least ${LEAST_CAMERAS} are needed. Choose three points of the floor.`,
    };
  const moment = [0, 1, 2].map((i) =>
    [0, 1, 2].map((j) => cameras.reduce((sum, { R: [right] }) => sum + right[i] * right[j], 0) / count),
  );
  const [least, second] = eigenvectors(moment);
  const [l0, l1] = [Math.max(least.value, 0), Math.max(second.value, 0)];
  if (Math.sqrt(l1) < LEAST_SPREAD)
    return {
      refused:
        "The cameras look in nearly one direction, which leaves the tilt open. Choose three points of the floor.",
    };
  const error = Math.sqrt((Math.max(l0, USUAL_ROLL ** 2) * l1) / count) / (l1 - l0);
  const cosines = cameras.map(({ R }) => -dot(least.vector, R[1]));
  const sum = cosines.reduce((total, cosine) => total + cosine, 0);
  const agreeing = Math.abs(sum) / cosines.reduce((total, cosine) => total + Math.abs(cosine), 0);
  if (!(error < MOST_ERROR) || !(Math.abs(sum) / count > LEAST_UP) || !(agreeing > LEAST_AGREEING)) {
    return {
      refused: "The cameras are rolled too differently to agree on one up direction. Choose three points of the floor.",
    };
  }
  return { up: least.vector.map((x) => (sum < 0 ? -x : x)), error, count };
}

// Three points that span a floor with an up direction, counterclockwise as seen from above.
function floorOf(up, at, size) {
  const level = Math.abs(up[0]) < 0.8 ? [1, 0, 0] : [0, 0, 1];
  const first = unit(plus(level, up, -dot(up, level)));
  return [at, plus(at, first, size), plus(at, cross(up, first), size)];
}

// The horizon of an up direction in a picture: two places at its borders, or null if it lies outside of them.
function horizonOf(up, { R, fx, fy, cx, cy, W, H }) {
  const [a, b, c] = rotated(R, up); // a (u - cx) / fx + b (v - cy) / fy + c = 0
  const row = (u) => ({ u, v: cy - (fy / b) * (c + (a * (u - cx)) / fx) });
  const column = (v) => ({ u: cx - (fx / a) * (c + (b * (v - cy)) / fy), v });
  const ends = Math.abs(b) * fx >= Math.abs(a) * fy ? [row(-0.5), row(W - 0.5)] : [column(-0.5), column(H - 0.5)];
  return ends.every(({ u, v }) => Number.isFinite(u) && Number.isFinite(v)) ? ends : null;
}

// The buttons and sliders of the tool "floor".
export class Leveller {
  constructor(editor) {
    this.editor = editor;
    this.angles = ["edit-pitch", "edit-roll"].map(element);
    this.begun = null; // {up, R} of the view in which a slider was moved first
    for (const slider of this.angles) slider.addEventListener("input", () => this.turn());
    this.reset();
    this.cameras = editor.viewer.facts.cameras.filter(({ saved }) => !saved);
    element("edit-cameras").hidden = !this.cameras.length;
  }

  // Pitch and roll, radians.
  get turns() {
    return this.angles.map(({ value }) => (Number(value) * Math.PI) / 180);
  }

  // The up direction of the line: that of the scene, turned by the pitch about the x axis of the view and then by the roll
  // about its line of sight.
  get up() {
    if (!this.begun) return this.editor.viewer.view.up;
    const { up, R } = this.begun;
    const [pitch, roll] = this.turns;
    return rotated(transposed(R), turned(turned(rotated(R, up), [1, 0, 0], pitch), [0, 0, 1], roll));
  }

  turn() {
    this.begun ??= { up: this.editor.viewer.view.up, R: this.editor.viewer.camera().R };
    this.tell();
    this.editor.redraw();
  }

  // Puts both sliders in the middle.
  reset() {
    this.begun = null;
    for (const slider of this.angles) slider.value = 0;
    this.tell();
  }

  tell() {
    const [pitch, roll] = this.angles.map(({ value }) => Number(value).toFixed(1));
    element("edit-tilts").textContent = `${pitch}°, ${roll}°`;
    this.angles.forEach((slider, i) => slider.setAttribute("aria-valuetext", `${[pitch, roll][i]} degrees`));
    this.editor.panel.button("level-angles").disabled = !this.turns.some(Boolean);
  }

  // Makes the line the horizon of the scene.
  levelByAngles() {
    const { editor } = this;
    const { pivot, distance } = editor.viewer.view;
    element("edit-turned").textContent = "";
    editor.perform({ op: "upright", points: floorOf(this.up, pivot, distance) });
  }

  draw(overlay, camera) {
    const line = horizonOf(this.up, camera);
    if (line) overlay.polyline(line, false, "#7fd4ff");
  }

  level() {
    const { editor } = this;
    const { up, error, count, refused } = upOfCameras(this.cameras);
    element("edit-turned").textContent = "";
    if (refused) return editor.say(refused);
    const { pivot, distance } = editor.viewer.view;
    const points = floorOf(up, pivot, distance);
    editor.perform({ op: "upright", points });
    const turn = degrees(Math.acos(Math.min(Math.max(dot(normalOf(points), EDIT_UP), -1), 1)));
    element("edit-turned").textContent =
      `${count} cameras turn the scene as opened by ${turn.toFixed(1)}°; standard error ${degrees(error).toFixed(1)}°.`;
    return undefined;
  }
}

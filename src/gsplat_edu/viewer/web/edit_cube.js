// What tells directions in the editor: a cube that turns with the view, whose sides are views along the scene's axes, and
// a grid on the ground.

import { element } from "./common.js";
import { cross, dot, plus, transposed, unit } from "./vectors.js";

const CUBE_SIDES = ["front", "back", "right", "left", "top", "bottom"];

const GRID_SAMPLE = 20000; // splats whose heights tell where the ground is
const BELOW_GROUND = 0.02; // share of them below the ground
const GRID_CELLS = 10; // of the grid, from its middle to each side

export class ViewCube {
  constructor(viewer) {
    this.viewer = viewer;
    const sides = CUBE_SIDES.map(
      (side) => `<button data-side="${side}" title="View from the ${side}">${side}</button>`,
    );
    const cube = `<div id="edit-cube" role="group" aria-label="views along the axes"><div>${sides.join("")}</div></div>`;
    document.body.insertAdjacentHTML("beforeend", cube);
    element("edit-cube").addEventListener(
      "click",
      ({ target }) => target.dataset.side && this.look(target.dataset.side),
    );
  }

  // The scene's right, down and forward, as the start view shows it upright.
  axes() {
    const { up, start } = this.viewer.view;
    const down = unit(up.map((x) => -x));
    const ahead = start.R.map((row) => plus(row, down, -dot(row, down))); // without what points down
    const forward = unit(Math.hypot(...ahead[2]) > 1e-3 ? ahead[2] : ahead[1]);
    return [cross(down, forward), down, forward];
  }

  // Turns the cube as a camera sees the scene. CSS has z towards the viewer.
  follow({ R }) {
    const seen = R.map((row) => this.axes().map((axis) => dot(row, axis)));
    const css = seen.map((row, i) => row.map((x, j) => ((i === 2) === (j === 2) ? x : -x)));
    const columns = transposed(css).flatMap((column) => [...column.map((x) => x.toFixed(5)), 0]);
    element("edit-cube").firstElementChild.style.transform = `matrix3d(${columns.join(",")},0,0,0,1)`;
  }

  // Moves the view so that it shows this side of what is in its middle.
  look(side) {
    const { view } = this.viewer;
    const [right, down, forward] = this.axes();
    const minus = (axis) => axis.map((x) => -x);
    const ahead = {
      front: forward,
      back: minus(forward),
      right: minus(right),
      left: right,
      top: down,
      bottom: minus(down),
    }[side];
    const across = side === "top" || side === "bottom" ? right : cross(down, ahead);
    const R = [across, cross(ahead, across), ahead];
    const eye = plus(view.focus, ahead, -view.distance);
    this.viewer.flyTo({ ...view.camera, R, eye }, -1);
  }

  // Lines of a grid on the ground around the pivot, whose cells have a length of 1, 2 or 5 times a power of ten.
  grid(values) {
    const { view } = this.viewer;
    const [right, down, forward] = this.axes();
    const level = groundLevel(values, down, view);
    const cell = roundLength(view.reach / GRID_CELLS);
    const middle = [right, forward].map((axis) => Math.round(dot(view.pivot, axis) / cell) * cell);
    const at = (x, z) =>
      plus(
        plus(
          right.map((r) => r * (middle[0] + x * cell)),
          forward,
          middle[1] + z * cell,
        ),
        down,
        level,
      );
    const steps = Array.from({ length: 2 * GRID_CELLS + 1 }, (_, i) => i - GRID_CELLS);
    return steps.flatMap((step) => [
      [at(step, -GRID_CELLS), at(step, GRID_CELLS)],
      [at(-GRID_CELLS, step), at(GRID_CELLS, step)],
    ]);
  }
}

// How far down the lowest splats are that can be seen, but for a few below the ground.
function groundLevel({ means, logits, count }, down, { pivot, reach }) {
  const stride = Math.max(1, Math.floor(count / GRID_SAMPLE));
  const depths = [];
  for (let i = 0; i < count; i += stride) {
    const mean = means.subarray(3 * i, 3 * i + 3);
    const offset = plus(pivot, mean, -1);
    if (logits[i] > 0 && Math.hypot(...offset) < reach) depths.push(dot(mean, down));
  }
  depths.sort((a, b) => b - a);
  return depths.length ? depths[Math.floor(BELOW_GROUND * depths.length)] : dot(pivot, down);
}

export function roundLength(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return ([5, 2].find((factor) => factor * power <= length) ?? 1) * power;
}

// Points of a picture in the cells of a grid, and a budget of tests, exactly as in gsplat_edu/edits/cells.py.

import { extent } from "./edit_member.js";

const CELLS = 64; // along each axis
export const MOST_TESTS = 1e10; // of a splat, for a list of operations

// Counts the tests of a list of operations.
export class EditWork {
  constructor(most = MOST_TESTS) {
    this.left = most;
  }

  // Counts tests that are about to be made; throws an Error with one line if there are too many.
  add(tests) {
    this.left -= tests;
    if (this.left < 0) {
      throw new Error(
        `The edits take more than ${MOST_TESTS.toLocaleString("en")} tests of a splat: use fewer or shorter strokes, or` +
          " convert the scene with these operations and edit the result.",
      );
    }
  }
}

// Points by the cell of a grid over their bounds. u, v: Float64Array of finite columns and rows.
export class Cells {
  constructor(u, v, work) {
    this.work = work;
    this.axes = [cellAxis(u), cellAxis(v)];
    const [alongU, alongV] = this.axes;
    const cells = new Uint16Array(u.length);
    this.starts = new Uint32Array(CELLS * CELLS + 1);
    for (let i = 0; i < u.length; ++i) {
      cells[i] = cellPlace(v[i], alongV) * CELLS + cellPlace(u[i], alongU);
      ++this.starts[cells[i] + 1];
    }
    for (let k = 0; k < CELLS * CELLS; ++k) this.starts[k + 1] += this.starts[k];
    const next = this.starts.slice();
    this.order = new Uint32Array(u.length);
    for (let i = 0; i < u.length; ++i) this.order[next[cells[i]]++] = i;
  }

  // Calls test(i) for the points in the cells that a rectangle touches. margin: further columns of cells on the right.
  touched(lowU, highU, lowV, highV, margin, test) {
    const [alongU, alongV] = this.axes;
    const [left, right] = [cellPlace(lowU, alongU), Math.min(cellPlace(highU, alongU) + margin, CELLS - 1)];
    const [top, bottom] = [cellPlace(lowV, alongV), cellPlace(highV, alongV)];
    let count = 0;
    for (let row = top; row <= bottom; ++row)
      count += this.starts[row * CELLS + right + 1] - this.starts[row * CELLS + left];
    this.work.add(count);
    for (let row = top; row <= bottom; ++row) {
      const end = this.starts[row * CELLS + right + 1];
      for (let k = this.starts[row * CELLS + left]; k < end; ++k) test(this.order[k]);
    }
  }
}

// The smallest value, and cells per px.
function cellAxis(values) {
  const [low, high] = extent(values);
  const scale = high > low ? CELLS / (high - low) : 0;
  return { low, scale: Number.isFinite(scale) ? scale : 0 };
}

function cellPlace(value, { low, scale }) {
  return scale === 0 ? 0 : Math.min(Math.max(Math.floor((value - low) * scale), 0), CELLS - 1);
}

// Points of a picture: those that a camera sees, in the cells of a grid, and a budget of tests, exactly as in
// gsplat_edu/edits/cells.py.

const CELLS = 64; // along each axis
const EDIT_NEAR = 0.05; // world units: splats at this camera depth or closer are not seen in a picture
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

// Calls found(i, u, v, z) for every splat in front of a picture's camera: u = (fx x) / z + cx, v = (fy y) / z + cy.
export function eachSeen({ camera }, { count, means }, found) {
  const [ex, ey, ez] = camera.position;
  const [[r00, r01, r02], [r10, r11, r12], [r20, r21, r22]] = camera.rotation; // camera to world: columns are the axes
  const { fx, fy, cx, cy } = camera;
  for (let i = 0, k = 0; i < count; ++i, k += 3) {
    const [a, b, c] = [means[k] - ex, means[k + 1] - ey, means[k + 2] - ez];
    const z = r02 * a + r12 * b + r22 * c;
    if (!(z > EDIT_NEAR)) continue;
    const x = r00 * a + r10 * b + r20 * c;
    const y = r01 * a + r11 * b + r21 * c;
    found(i, (fx * x) / z + cx, (fy * y) / z + cy, z);
  }
}

// The smallest and the largest number.
export function extent(numbers) {
  return numbers.reduce(([low, high], x) => [Math.min(low, x), Math.max(high, x)], [Infinity, -Infinity]);
}

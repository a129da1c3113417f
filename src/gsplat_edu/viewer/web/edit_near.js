// Splats near those of a set, by a hash of cells: exactly as in gsplat_edu/edits/neighbours.py, which says why.

import { SELECTED } from "./edit_flags.js";
import { MOST_SAMPLED, shortNumber } from "./edit_shapes.js";

const HALF_CELLS = 1 << 16; // along each axis on either side of the median
const WIDER_CELLS = 1.001; // side of a cell, in radii
const MOST_PAIRS = 1e9; // tests that one operation may take
const PROPOSED_RADIUS = 3; // in median sizes of the splats

// Splats by the cell that their centre lies in.
class CellHash {
  // at: indices of splats with finite centres, at least one. side: of a cell.
  constructor(means, at, side) {
    Object.assign(this, { means, side });
    this.middle = [0, 1, 2].map((axis) => Float64Array.from(at, (i) => means[3 * i + axis]).sort()[at.length >> 1]);
    const group = (rows) => {
      const cells = new Map(); // number of a cell to its splats
      for (const i of rows) {
        const number = this.number(...this.cell(i));
        const found = cells.get(number);
        if (found) found.push(i);
        else cells.set(number, [i]);
      }
      return cells;
    };
    this.cells = group(at);
    this.group = group;
  }

  cell(i) {
    const { means, middle, side } = this;
    const along = (axis) => {
      const place = Math.floor((means[3 * i + axis] - middle[axis]) / side);
      return Math.min(Math.max(place, -HALF_CELLS), HALF_CELLS - 1) + HALF_CELLS;
    };
    return [along(0), along(1), along(2)];
  }

  number(x, y, z) {
    return (z * 2 * HALF_CELLS + y) * 2 * HALF_CELLS + x;
  }

  // The splats of the 27 cells around the one of a splat, as lists.
  around(i) {
    const [x, y, z] = this.cell(i);
    const steps = (place) => [place - 1, place, place + 1].filter((p) => p >= 0 && p < 2 * HALF_CELLS);
    const found = [];
    for (const k of steps(z)) {
      for (const j of steps(y)) {
        for (const h of steps(x)) {
          const list = this.cells.get(this.number(h, j, k));
          if (list) found.push(list);
        }
      }
    }
    return found;
  }
}

// The splats i with isJudged(i) whose centre lies within a radius of that of one with isOther(i), as indices. Throws an
// Error with one line, before anything is compared, if that takes too many tests.
function withinRadius({ count, means }, isJudged, isOther, radius, work) {
  work.add(count);
  const chosen = (wanted) => {
    const at = [];
    for (let i = 0, k = 0; i < count; ++i, k += 3) {
      if (wanted(i) && Number.isFinite(means[k]) && Number.isFinite(means[k + 1]) && Number.isFinite(means[k + 2]))
        at.push(i);
    }
    return at;
  };
  const [judged, others] = [chosen(isJudged), chosen(isOther)];
  if (!judged.length || !others.length) return [];
  const hash = new CellHash(means, others, WIDER_CELLS * radius);
  const groups = [...hash.group(judged).values()].map((rows) => ({ rows, near: hash.around(rows[0]) }));
  const pairs = groups.reduce(
    (sum, { rows, near }) => sum + rows.length * near.reduce((n, list) => n + list.length, 0),
    0,
  );
  if (pairs > MOST_PAIRS) {
    const number = (value) => value.toLocaleString("en");
    throw new Error(
      `A radius of ${shortNumber(radius)} takes ${number(pairs)} tests of a splat, but ${number(MOST_PAIRS)} are` +
        " allowed: give a smaller radius.",
    );
  }
  work.add(pairs);
  const square = radius * radius;
  const isNear = (i, lists) => {
    const [x, y, z] = [means[3 * i], means[3 * i + 1], means[3 * i + 2]];
    for (const list of lists) {
      for (const j of list) {
        const [a, b, c] = [x - means[3 * j], y - means[3 * j + 1], z - means[3 * j + 2]];
        if (a * a + b * b + c * c <= square) return true;
      }
    }
    return false;
  };
  const found = [];
  for (const { rows, near } of groups) if (near.length) for (const i of rows) if (isNear(i, near)) found.push(i);
  return found;
}

// Applies "grow" or "shrink" to the states, in place; throws an Error, before anything is changed, if it is too much.
export function applyNear({ op, radius }, values, flags, work) {
  const [from, to] = op === "grow" ? [0, SELECTED] : [SELECTED, 0];
  for (const i of withinRadius(
    values,
    (i) => flags[i] === from,
    (i) => flags[i] === to,
    radius,
    work,
  ))
    flags[i] = to;
}

// A radius for "grow" and "shrink" to begin with: a few times the median size of the splats, with two digits.
export function proposedRadius({ count, log_scales }) {
  const every = Math.max(1, Math.floor(count / MOST_SAMPLED));
  const sizes = [];
  for (let i = 0; i < count; i += every) {
    const size = Math.exp(Math.max(log_scales[3 * i], log_scales[3 * i + 1], log_scales[3 * i + 2]));
    if (size > 0 && size < Infinity) sizes.push(size);
  }
  if (!sizes.length) return 1;
  return Number((PROPOSED_RADIUS * sizes.sort((a, b) => a - b)[sizes.length >> 1]).toPrecision(2));
}

// Whether a splat lies in runs of indices, [start, count, ...].
export function listMembers({ runs }, { count }) {
  const inside = new Uint8Array(count);
  for (let k = 0; k < runs.length; k += 2) inside.fill(1, runs[k], runs[k] + runs[k + 1]);
  return inside;
}

export const NEAR_PANEL = `
<p class="row" role="group" aria-label="neighbours"><label>radius <input id="edit-near" type="number" min="0" step="any"></label>
<button data-do="grow" title=".: select also what lies within the radius of the selection">grow</button>
<button data-do="shrink" title=",: deselect what lies within the radius of what is not selected">shrink</button></p>`;

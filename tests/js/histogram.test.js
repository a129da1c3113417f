import assert from "node:assert/strict";
import { test } from "node:test";

import { counted } from "../../src/gsplat_edu/viewer/web/edit_histogram.js";

const [VISIBLE, SELECTED, HIDDEN] = [0, 1, 2];

function splats(logits, means = logits.flatMap((_, i) => [i, 0, 0])) {
  return { count: logits.length, logits, means, log_scales: means };
}

test("opacities from 0 to 1 are counted in fifty bars, hidden splats in none", () => {
  const logits = [-Infinity, -5, 0, 0, 5, Infinity, 0];
  const flags = [VISIBLE, VISIBLE, VISIBLE, SELECTED, SELECTED, VISIBLE, HIDDEN];
  const { ends, all, selected } = counted("opacity", splats(logits), flags, [0, 0, 0]);
  assert.deepEqual(ends, [0, 1]);
  assert.deepEqual([all[0], all[25], all[49]], [2, 2, 2]);
  assert.deepEqual([selected[0], selected[25], selected[49]], [0, 1, 1]);
  assert.deepEqual(
    [...all].reduce((a, b) => a + b),
    6,
  );
});

test("distances are logarithmic from the pivot, and a splat at the pivot lies in the first bar", () => {
  const means = [2, 0, 0, 2, 0, 3, 2, 0, 30, 2, 1e-12, 0];
  const { ends, all } = counted("distance", splats([0, 0, 0, 0], means), [0, 0, 0, 0], [2, 0, 0]);
  assert.deepEqual(ends, [Math.log(30) + Math.log(1e-6), Math.log(30)]);
  const bar = Math.floor((50 * (Math.log(3) - ends[0])) / (ends[1] - ends[0]));
  assert.deepEqual([all[0], all[bar], all[49]], [2, 1, 1]);
});

test("equal sizes, and no visible splat, give an axis of some length", () => {
  const equal = splats([0, 0], [1, 1, 1, 1, 1, 1]);
  assert.deepEqual(counted("size", equal, [0, 0], null).ends, [0, 2]);
  assert.equal(counted("size", equal, [0, 0], null).all[25], 2);
  assert.deepEqual(counted("size", equal, [HIDDEN, HIDDEN], null).ends, [0, 1]);
});

import assert from "node:assert/strict";
import { test } from "node:test";

import { EditWork, MOST_TESTS } from "../../src/gsplat_edu/viewer/web/edit_cells.js";
import { members } from "../../src/gsplat_edu/viewer/web/edit_member.js";
import { DELETED } from "../../src/gsplat_edu/viewer/web/edit_flags.js";
import { newBox } from "../../src/gsplat_edu/viewer/web/edit_shapes.js";
import { applyOperation, EditHistory } from "../../src/gsplat_edu/viewer/web/edit_state.js";
import { movedTogether } from "../../src/gsplat_edu/viewer/web/edit_move.js";
import { arrayOf, assertClose, vectors } from "./vectors.js";

const placesOf = (flags) => [...flags].flatMap((flag, i) => (flag ? [i] : []));

test("a region holds the same splats as in Python, whatever their values", () => {
  const { count, arrays, regions, inside, left } = vectors("regions");
  const values = { count };
  for (const [name, numbers] of Object.entries(arrays)) values[name] = arrayOf(numbers);
  const work = new EditWork();
  for (const [i, region] of regions.entries()) {
    assert.deepEqual(placesOf(members(region, values, work)), inside[i], JSON.stringify(region));
  }
  assert.equal(work.left, left, "both count equally many tests, so both refuse the same files");
  assert.ok(left < MOST_TESTS);
  const some = inside.filter(({ length }) => length > 0 && length < count);
  assert.ok(some.length > 50, "most regions contain some splats but not all");
});

for (const spread of ["odd", "grid", "far"]) {
  test(`a selection grows and shrinks as in Python: ${spread}`, () => {
    const { means, flags, cases } = vectors(`near-${spread}`);
    const values = { count: flags.length, means: arrayOf(means) };
    const work = new EditWork();
    let changes = 0;
    for (const { op, radius, flags: expected, left } of cases) {
      const after = Uint8Array.from(flags);
      applyOperation({ op, radius }, values, after, work);
      assert.deepEqual([...after], expected, `${op} ${radius}`);
      assert.equal(work.left, left);
      if (after.some((flag, i) => flag !== flags[i])) ++changes;
    }
    assert.ok(changes > 10);
  });
}

test("a radius that takes too many tests is refused, and nothing changes", () => {
  const values = { count: 80000, means: new Float32Array(240000) };
  const flags = new Uint8Array(80000).fill(1, 40000);
  assert.throws(() => applyOperation({ op: "grow", radius: 0.5 }, values, flags, new EditWork()), {
    message:
      "A radius of 0.5 takes 1,600,000,000 tests of a splat, but 1,000,000,000 are allowed: give a smaller radius.",
  });
  assert.equal(
    flags.reduce((sum, flag) => sum + flag),
    40000,
  );
});

for (const forgets of [false, true]) {
  test(`moves, undo and redo agree with a witness on every bit${forgets ? ", without stored states" : ""}`, () => {
    for (const { operations, means, flags, after } of vectors("moves")) {
      const [start, end] = [arrayOf(means), Float32Array.from(arrayOf(after))];
      const values = { count: flags.length, means: start.slice() };
      const history = new EditHistory(values, []);
      for (const operation of operations) history.perform(operation);
      assert.deepEqual([...history.flags], flags);
      assert.deepEqual(values.means, end);
      assert.notDeepEqual(start, end);
      if (forgets) {
        for (let i = 0; i < history.changes.length; ++i) history.forget(i);
        assert.equal(history.bytes, 0);
      }
      for (const operation of [...operations].reverse()) assert.equal(history.undo(), operation);
      assert.equal(history.undo(), undefined);
      assert.ok(history.flags.every((flag) => flag === 0));
      assert.deepEqual(values.means, start);
      assert.ok(values.motion.turned.every((index) => index === 0));
      for (const operation of operations) assert.equal(history.redo(), operation);
      assert.deepEqual([...history.flags], flags);
      assert.deepEqual(values.means, end);
    }
  });
}

test("what moves together is what Python says", () => {
  const cases = vectors("moved-parts");
  for (const { operations, means, R, t, partly } of cases) {
    const history = new EditHistory({ count: 40, means: arrayOf(means) }, operations);
    const { whole, some } = movedTogether(history.values, history.flags);
    assertClose([whole.R, whole.t], [R, t], { absolute: 1e-12 });
    assert.equal(some, partly);
  }
  assert.ok(cases.some(({ stays, partly }) => !stays && partly));
  assert.ok(cases.some(({ stays, partly }) => !stays && !partly));
});

test("a new box starts around what most cameras look at while something is left there", () => {
  const count = 200;
  const means = Float32Array.from({ length: 3 * count }, (_, i) => 10 + (i % 7)); // far away
  means.set([0, 0, 0], 0);
  const flags = new Uint8Array(count);
  const rotation = [
    [0, 1, 0],
    [1, 0, 0],
    [0, 0, -1],
  ];
  const subject = { center: [0.5, 0, 0], rotation, half: [0.1, 0.6, 0.1] };
  const up = [0, -1, 0];
  assert.equal(newBox({ count, means }, flags, up, subject), subject);
  assert.equal(newBox({ count, means }, flags, up, { ...subject, half: [0.1, 0.4, 0.1] }).center[0] > 9, true);
  flags[0] = DELETED;
  const around = newBox({ count, means }, flags, up, subject);
  for (const [j, middle] of around.center.entries()) {
    assert.ok(middle - around.half[j] > 9 && middle + around.half[j] < 17);
  }
  assert.deepEqual(newBox({ count, means }, flags, up, null), around);
});

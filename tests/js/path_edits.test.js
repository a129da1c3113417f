import assert from "node:assert/strict";
import { test } from "node:test";
import { readKeyframe } from "../../src/gsplat_edu/viewer/web/keyframes.js";
import { PathCurve } from "../../src/gsplat_edu/viewer/web/path.js";
import * as edits from "../../src/gsplat_edu/viewer/web/path_edits.js";
import { assertClose, vectors } from "./vectors.js";

// A view whose number is its place on the x axis.
const view = (number) => ({
  eye: [number, 0, -4],
  R: [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ],
  fov: 50,
});

const pathOf = (times, more = {}) => ({
  loop: false,
  duration: null,
  ease: null,
  keyframes: times.map((time, i) => ({ ...view(i), time })),
  ...more,
});

const TIMED = pathOf([0, 1, 3, 6]);
const UNTIMED = pathOf(Array(4).fill(undefined), { duration: 9 });

const timesIn = ({ keyframes }) => keyframes.map(({ time }) => time);

function assertIs({ path, chosen }, order, times, place) {
  assert.deepEqual(
    path.keyframes.map(({ eye }) => eye[0]),
    order,
  );
  assertClose(timesIn(path), times, { absolute: 1e-9 });
  assert.equal(chosen, place);
}

test("a view moves past its neighbours, and pushes later ones", () => {
  assertIs(edits.withTime(TIMED, 2, 4.2), [0, 1, 2, 3], [0, 1, 4.2, 6], 2);
  assertIs(edits.withTime(TIMED, 2, 0.5), [0, 2, 1, 3], [0, 0.5, 1, 6], 1);
  assertIs(edits.withTime(TIMED, 0, 2), [1, 0, 2, 3], [0, 1, 2, 5], 1);
  assertIs(edits.withTime(TIMED, 1, 3), [0, 1, 2, 3], [0, 3, 3.01, 6], 1);
  assertIs(edits.withTime(TIMED, 3, -1), [3, 0, 1, 2], [0, 1, 2, 4], 0);
});

test("a rest pushes later views, and shrinks and grows with the path", () => {
  const rested = edits.withRest(edits.withTime(TIMED, 1, 1.5).path, 1, 2.5);
  assertClose(timesIn(rested), [0, 1.5, 4.01, 6], { absolute: 1e-9 });
  const longer = edits.lasting(rested, 12);
  assertClose(timesIn(longer), [0, 3, 8.02, 12], { absolute: 1e-9 });
  assertClose(longer.keyframes.map(edits.restOf), [0, 5, 0, 0], { absolute: 1e-9 });
  assert.equal(edits.withRest(longer, 1, 0).keyframes[1].hold, undefined);
});

test("views change places, and each place keeps its time", () => {
  assertIs({ path: edits.swapped(TIMED, 1, 2) }, [0, 2, 1, 3], [0, 1, 3, 6]);
  assert.deepEqual(edits.swapped(edits.swapped(UNTIMED, 1, 2), 2, 1), UNTIMED);
});

test("a view is inserted at a time, between two views, or at the end", () => {
  assertIs(edits.inserted(TIMED, view(9), 2), [0, 1, 9, 2, 3], [0, 1, 2, 3, 6], 2);
  assertIs(edits.inserted(TIMED, view(9), 3), [0, 1, 2, 9, 3], [0, 1, 3, 4.5, 6], 3);
  assertIs(edits.inserted(TIMED, view(9), 6), [0, 1, 2, 3, 9], [0, 1, 3, 6, 8], 4);
  const rested = edits.withRest(TIMED, 1, 1.5);
  assertIs(edits.inserted(rested, view(9), 2), [0, 1, 9, 2, 3], [0, 1, 2.75, 3, 6], 2);
});

test("a path without times keeps its speed until a view gets a time", () => {
  const { path, chosen } = edits.inserted(UNTIMED, view(9), 1);
  assert.deepEqual([path.duration, chosen, timesIn(path)], [12, 1, Array(5).fill(undefined)]);
  assert.equal(edits.lasting(UNTIMED, 4).duration, 4);
  const met = edits.timesOf(UNTIMED);
  assertClose(met, [0, 3, 6, 9], { absolute: 1e-6 }); // a straight line of equal steps
  assertClose(timesIn(edits.withTime(UNTIMED, 3, 9.1).path), [...met.slice(0, 3), 9.1], { absolute: 1e-9 });
});

test("a loop keeps its duration and some time for the way back", () => {
  const loop = { ...TIMED, loop: true, duration: 8 };
  assert.equal(edits.withTime(loop, 3, 7).path.duration, 8);
  const later = edits.withTime(loop, 3, 9).path;
  assertClose([later.duration], [9 + edits.PATH_GAP], { absolute: 1e-9 });
  const longer = edits.lasting(later, 2 * later.duration);
  assertClose([longer.duration, timesIn(longer)[3]], [18.02, 18], { absolute: 1e-9 });
  assert.equal(edits.grown(TIMED, { loop: true }).duration, 8, "the mean time between views");
  assert.equal(edits.grown(loop, { loop: false }).duration, null);
});

// What Python checks when it reads a path, with the page's gap instead of the least step.
function assertReadable(path) {
  const times = timesIn(path);
  assert.ok(path.duration === null || path.duration > 0);
  if (times.every((time) => time === undefined)) return;
  const ends = path.keyframes.map((keyframe) => keyframe.time + edits.restOf(keyframe));
  const gap = edits.PATH_GAP * (1 - 1e-9);
  assert.equal(times[0], 0);
  times.slice(1).forEach((time, i) => assert.ok(time - ends[i] >= gap, `${times}`));
  assert.ok(path.loop ? path.duration - ends.at(-1) >= gap : path.duration === null);
  assert.ok(path.keyframes.every(({ hold }) => hold === undefined || hold > 0));
}

test("a hundred random edits leave a path that Python reads", () => {
  let state = 5;
  const random = (low, high) => low + (high - low) * ((state = (state * 48271) % 2147483647) / 2147483647);
  for (const { path: start } of vectors("paths")) {
    let path = { duration: null, ease: null, ...start, keyframes: start.keyframes.map(readKeyframe) };
    path = edits.withTime(path, 0, 0).path;
    for (let i = 0; i < 100; ++i) {
      const count = path.keyframes.length;
      const index = Math.floor(random(0, count));
      const changes = [
        () => edits.withTime(path, index, random(-2, 12)).path,
        () => edits.withRest(path, index, random(-1, 3)),
        () => edits.lasting(path, random(0.5, 20)),
        () => edits.inserted(path, view(i), random(0, new PathCurve(path).seconds)).path,
        () => edits.swapped(path, index, (index + 1) % count),
        () => edits.appended(path, view(i)),
        () => edits.grown(path, { loop: !path.loop }),
        () => edits.grown(path, { keyframes: count > 3 ? path.keyframes.toSpliced(index, 1) : path.keyframes }),
      ];
      path = changes[Math.floor(random(0, changes.length))]();
      if (path.keyframes[0].time) path = edits.withTime(path, 0, 0).path; // the first view was removed
      assertReadable(path);
    }
  }
});

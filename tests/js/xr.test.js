import assert from "node:assert/strict";
import { test } from "node:test";

import { View } from "../../src/gsplat_edu/viewer/web/camera.js";
import { SortedSplats } from "../../src/gsplat_edu/viewer/web/sorted_splats.js";
import {
  along,
  eyeCamera,
  heading,
  headOf,
  metreOf,
  placed,
  Push,
  pushes,
  standAt,
  turnedStand,
  wayOf,
} from "../../src/gsplat_edu/viewer/web/xr.js";
import { cross, dot, plus } from "../../src/gsplat_edu/viewer/web/vectors.js";
import { assertClose } from "./vectors.js";

const NEARLY = { absolute: 1e-6 }; // WebXR's matrices are float32
const radians = (degrees) => (degrees * Math.PI) / 180;

// The matrix, by columns, of a head at a place that is turned to the left and then looks up, by degrees.
function pose(at, left = 0, up = 0) {
  const [sin, cos] = [Math.sin(radians(left)), Math.cos(radians(left))];
  const [rise, run] = [Math.sin(radians(up)), Math.cos(radians(up))];
  const columns = [
    [cos, 0, -sin],
    [sin * rise, run, cos * rise],
    [sin * run, -rise, cos * run],
  ];
  return Float32Array.from([...columns.flatMap((one) => [...one, 0]), ...at, 1]);
}

// WebXR's projection of a picture that reaches to these tangents.
function projection({ left, right, top, bottom }) {
  const [near, far] = [0.1, 1000];
  const [width, height, depth] = [right - left, top - bottom, near - far];
  return Float32Array.from([
    ...[2 / width, 0, 0, 0],
    ...[0, 2 / height, 0, 0],
    ...[(right + left) / width, (top + bottom) / height, (far + near) / depth, -1],
    ...[0, 0, (2 * far * near) / depth, 0],
  ]);
}

// A camera 3 above the ground of a scene whose up is +z. It looks along +y and down.
const TILT = radians(35);
const SCENE_UP = [0, 0, 1];
const CAMERA = {
  R: [
    [1, 0, 0],
    [0, -Math.sin(TILT), -Math.cos(TILT)],
    [0, Math.cos(TILT), -Math.sin(TILT)],
  ],
  eye: [10, 20, 3],
};
const HEAD = headOf(pose([0.4, 1.6, -0.3], 25, -10));
const STAND = standAt(CAMERA, SCENE_UP, HEAD, 5);

test("a scene of known unit has its size, another one its subject at two metres", () => {
  assert.deepEqual(
    ["m", "cm", "mm", null].map((name) => metreOf(name, 7)),
    [1, 100, 1000, 3.5],
  );
});

test("the head starts in the view, level, and heads where the view does", () => {
  assertClose(placed(STAND, HEAD.at), CAMERA.eye, NEARLY);
  assertClose(along(STAND, [0, 1, 0]), SCENE_UP, NEARLY);
  assertClose(along(STAND, HEAD.heading), [0, 1, 0], NEARLY);
  const [right, up, back] = STAND.axes;
  assertClose(cross(right, up), back, NEARLY);
  assertClose(placed(STAND, plus(HEAD.at, [0, -1, 0])), [10, 20, -2], NEARLY); // a metre has five units
});

test("who looks straight down or up heads where the forehead or the neck points", () => {
  assertClose(headOf(pose([0, 0, 0], 90, 0)).heading, [-1, 0, 0], NEARLY);
  for (const tilt of [-90, -80, 80, 90])
    assertClose(headOf(pose([0, 0, 0], 90, tilt)).heading, [-1, 0, 0], { absolute: 1e-5 });
  assertClose(heading([0, 0, -1], [0, 1, 0], SCENE_UP), [0, 1, 0], NEARLY);
  assertClose(heading([0, 0, 1], [0, 1, 0], SCENE_UP), [0, -1, 0], NEARLY);
});

test("an eye's camera sees points where WebXR's matrices project them", () => {
  const matrix = pose([0.43, 1.7, -0.2], -40, 15);
  const shown = projection({ left: -1.2, right: 0.8, top: 0.9, bottom: -1.1 });
  const camera = eyeCamera(STAND, matrix, shown, { width: 300, height: 260 });
  assertClose(cross(camera.R[0], camera.R[1]), camera.R[2], NEARLY);
  for (const local of [
    [0, 0, -1],
    [0.5, -0.7, -2],
    [-3, 2, -4],
  ]) {
    const clip = [0, 1, 3].map((row) => [...local, 1].reduce((sum, x, i) => sum + shown[4 * i + row] * x, 0));
    const [u, v] = [0.5 * (1 + clip[0] / clip[2]) * 300 - 0.5, 0.5 * (1 - clip[1] / clip[2]) * 260 - 0.5];
    const inSpace = [0, 1, 2].map((row) => [...local, 1].reduce((sum, x, i) => sum + matrix[4 * i + row] * x, 0));
    const offset = plus(placed(STAND, inSpace), camera.eye, -1);
    const [x, y, z] = camera.R.map((axis) => dot(axis, offset));
    assertClose([(camera.fx * x) / z + camera.cx, (camera.fy * y) / z + camera.cy], [u, v], { absolute: 1e-3 });
    assertClose(z, -5 * local[2], { absolute: 1e-5 });
  }
});

test("twelve snap turns are a whole one, about the head", () => {
  let stand = turnedStand(STAND, HEAD, 1);
  assertClose(placed(stand, HEAD.at), CAMERA.eye, NEARLY);
  // 30 degrees to the right of +y, with up +z
  assertClose(along(stand, HEAD.heading), [0.5, Math.sqrt(0.75), 0], NEARLY);
  for (let i = 0; i < 11; ++i) stand = turnedStand(stand, HEAD, 1);
  assertClose(stand.axes, STAND.axes, NEARLY);
  assertClose(turnedStand(turnedStand(STAND, HEAD, 1), HEAD, -1).origin, STAND.origin, NEARLY);
});

test("the left stick moves and any other one turns, behind the axes of a touchpad", () => {
  const source = (handedness, axes) => ({ handedness, gamepad: axes && { axes } });
  assert.deepEqual(pushes([source("left", [9, 9, 0.5, -1]), source("right", [9, 9, 0.8, 0.1])]), {
    turn: 0.8,
    move: [0.5, -1],
  });
  assert.deepEqual(pushes([source("none", [0.3, 0.2]), source("left", null), source("right", [])]), {
    turn: 0.3,
    move: [0, 0],
  });
});

test("a push counts once, until the stick has come back", () => {
  const push = new Push();
  const lengths = [0.6, 0.8, 1, 0.5, 0.9, 0.3, 0.6, 0.75];
  assert.deepEqual(
    lengths.map((far) => push.begins(far)),
    [false, true, false, false, false, false, false, true],
  );
});

test("a push moves on the level in the direction of the head", () => {
  assertClose(wayOf(STAND, HEAD, [0, -1], { seconds: 0.2 }), [0, 1, 0], NEARLY); // 0.2 m
  assertClose(wayOf(STAND, HEAD, [1, 0], { isStep: true }), [2.5, 0, 0], NEARLY); // half a metre
  assertClose(wayOf(STAND, HEAD, [0.1, 0.1], { seconds: 1 }), [0, 0, 0], NEARLY); // a stick at rest
  assertClose(wayOf(STAND, HEAD, [0, 0], { seconds: 1 }), [0, 0, 0], NEARLY);
  assertClose(wayOf(STAND, HEAD, [0, 1], { isStep: false }), [0, 0, 0], NEARLY);
  const turned = turnedStand(STAND, HEAD, 3);
  assertClose(wayOf(turned, HEAD, [0, -1], { seconds: 1 }), [5, 0, 0], NEARLY);
});

test("a move of a head is bounded from where the head is", () => {
  const eyes = [[0, 0, 0]];
  const view = new View({ camera: { R: CAMERA.R, eye: eyes[0] }, pivot: [0, 4, 0], up: SCENE_UP }, eyes);
  view.bounds = "photos";
  assert.equal(view.share([0, -1, 0]), 1);
  assert.ok(view.share([0, -3, 0], [0, -2, 0]) < 0.1);
  assert.equal(view.share([0, -1, 0], [0, -2, 0]), 1, "back to the photos");
});

test("without an axis, splats are sorted by distance in all directions", () => {
  const means = Float32Array.of(0, 0, 1, 0, 0, -3, 2, 0, 0, 0, 0.01, 0);
  const order = new Uint32Array(4);
  const splats = new SortedSplats([means, null, null], 0.05);
  assert.equal(splats.sort(undefined, [0, 0, 0], order, Infinity).count, 3);
  assert.deepEqual([...order.subarray(0, 3)], [1, 2, 0]);
});

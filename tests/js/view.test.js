import assert from "node:assert/strict";
import { test } from "node:test";

import { View, fitted } from "../../src/gsplat_edu/viewer/web/camera.js";
import { dot, plus } from "../../src/gsplat_edu/viewer/web/vectors.js";
import { assertClose } from "./vectors.js";

const PIXEL = 1 / 640; // of a drag, in those across the window
const UP = [0, -1, 0];
const AHEAD = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];
const degrees = (radians) => (radians * 180) / Math.PI;
const away = (a, b) => Math.hypot(...plus(a, b, -1));

// Eleven cameras side by side face a subject that is 4 ahead; the view is that of one of them.
const EYES = Array.from({ length: 11 }, (_, i) => [0.2 * (i - 5), 0.05 * (i % 3), 0]);
const SUBJECT = [0, 0, 4];
const forward = () => new View({ camera: { R: AHEAD, eye: EYES[5] }, pivot: SUBJECT, up: UP }, EYES);

function drag(view, dx, dy) {
  const angle = view.turn * PIXEL;
  view.orbit(dx * angle, dy * angle);
}

// The angle between the view and the nearest camera, seen from the pivot, degrees.
function offTheCameras({ camera: { eye }, focus }) {
  const towards = (from) => plus(from, focus, -1).map((x) => x / away(from, focus));
  return degrees(Math.acos(Math.min(1, Math.max(...EYES.map((one) => dot(towards(eye), towards(one)))))));
}

test("a drag across a quarter of the window stays near the cameras, however fast it is", () => {
  const view = forward();
  for (const [dx, dy] of [
    [160, 0],
    [-160, 0],
    [0, 100],
    [0, -100],
    [160, 100],
  ]) {
    view.reset();
    drag(view, dx, dy);
    const fast = offTheCameras(view);
    assert.ok(fast > 0.5 && fast < 15, `${fast}`); // 6 degrees are free; beyond them it moves less and less
    assertClose(view.distance, 4, { absolute: 1e-12 });
  }
  const moved = offTheCameras(view);
  for (let i = 0; i < 4; ++i) drag(view, 160, 100);
  const found = offTheCameras(view);
  assert.ok(found > moved && found < 35, "repeated drags still move the view, slowly");
  const [fast, slow] = [1, 40].map((moves) => {
    view.reset();
    for (let i = 0; i < moves; ++i) drag(view, 640 / moves, 0);
    return offTheCameras(view);
  });
  assertClose(fast, slow, { absolute: 0.1 });
});

test("after flying outside one can orbit there", () => {
  const view = forward();
  view.camera = { ...view.camera, eye: [4, 0, 4] };
  view.look(-1.5, 0);
  const before = view.camera.eye;
  assert.ok(offTheCameras(view) > 25);
  drag(view, -60, 0);
  assert.ok(away(view.camera.eye, before) > 0.1);
  drag(view, 60, 0);
  assert.ok(away(view.camera.eye, before) < 0.15, `${away(view.camera.eye, before)}`);
});

test("no drag turns the world upside down", () => {
  const view = new View({ camera: { R: AHEAD, eye: [0, 0, -2] }, pivot: [0, 0, 0], up: UP }, []);
  for (const dy of [90, 90, 90, 90, 90, ...Array(10).fill(-90)]) {
    for (let i = 0; i < 12; ++i) drag(view, 0.25, dy / 12);
    assert.ok(dot(view.camera.R[1], UP) < 0);
  }
});

test("zooming and panning are limited, so that a visitor cannot lose the scene", () => {
  const eyes = [
    [0.4, -0.6, -2.2],
    [2, -0.5, 0.3],
    [-1, -0.4, 2],
  ];
  const farthest = Math.max(...eyes.map((eye) => Math.hypot(...eye)));
  const view = new View({ camera: { R: AHEAD, eye: eyes[0] }, pivot: [0, 0, 0], up: UP }, eyes);
  const often = (act) => {
    for (let i = 0; i < 200; ++i) act();
  };
  often(() => view.zoom(1.2));
  assert.ok(view.distance > farthest && view.distance < 4 * farthest);
  often(() => view.pan(300, 100, { fx: 230, fy: 250 }));
  const panned = Math.hypot(...view.focus);
  assert.ok(panned > farthest && panned < 5 * farthest);
  often(() => view.zoom(0.8));
  assert.ok(view.distance > 0.005 * farthest && view.distance < 0.05 * farthest);
});

test("a window of any shape keeps the middle of the photo, crops at most a fifth of its height and adds at most half of it", () => {
  const photo = { R: AHEAD, eye: [0, 0, 0], fx: 230, fy: 250, cx: 150.3, cy: 108.6, W: 320, H: 200 };
  for (const [width, height, covered, scale] of [
    [390, 844, 200, 3.22 / 1.5], // a narrow window shows half as much again as the height, and on a phone below the panel
    [160, 500, 0, 2.5 / 1.5],
    [300, 200, 0, 0.9375], // and no more than it needs for the whole width
    [320, 200, 0, 1],
    [400, 200, 0, 1.25], // a wide window shows the whole width
    [800, 200, 0, 1.25], // a wider one crops no more, and shows the surroundings
    [800, 200, 170, 1.25], // a panel over nearly all of a low window does not count
  ]) {
    const free = covered > 0.8 * height ? height : height - covered;
    const { fx, fy, cx, cy, W, H } = fitted(photo, width, height, covered);
    assert.deepEqual([W, H], [width, height]);
    assertClose([fx, fy], [scale * photo.fx, scale * photo.fy], { relative: 1e-12 });
    // edges of the free part of the window, px of the photo
    const [left, right] = [-0.5, width - 0.5].map((x) => (x - cx) / scale + photo.cx);
    const [top, bottom] = [height - free - 0.5, height - 0.5].map((y) => (y - cy) / scale + photo.cy);
    assertClose([left + right, top + bottom], [photo.W - 1, photo.H - 1], { absolute: 1e-9 });
  }
});

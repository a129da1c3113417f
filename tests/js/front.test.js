import assert from "node:assert/strict";
import { test } from "node:test";

import { EditWork } from "../../src/gsplat_edu/viewer/web/edit_cells.js";
import { frontOf, visibleSurface } from "../../src/gsplat_edu/viewer/web/edit_front.js";
import { members } from "../../src/gsplat_edu/viewer/web/edit_member.js";
import { depthAtPixel } from "../../src/gsplat_edu/viewer/web/edit_pixel.js";
import { pictureOf } from "../../src/gsplat_edu/viewer/web/edit_shapes.js";
import { rayMeets } from "../../src/gsplat_edu/viewer/web/mesh_rays.js";
import { arrayOf, assertClose, vectors } from "./vectors.js";

// The page's shader begins with its constants.
const shader = Object.entries(vectors("constants")).map(([name, value]) => `const float ${name} = ${value};`);
globalThis.document = { getElementById: () => ({ textContent: shader.join("\n") }) };

const SETTINGS = { jacobian_limit: 1.3, beyond: null, antialiased: false };
const NEAR = 0.05;
const THICKNESS = 0.01;
const [NEAR_WALL, FAR_WALL] = [0, 0.8];
const R = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];
const CAMERA = { R, eye: [0, 0, -3], fx: 400, fy: 400, cx: 319.5, cy: 199.5, W: 640, H: 400 };

// Centres of a wall that faces the camera.
function wall(z, [a, b], step = 0.1) {
  const along = (half) => Array.from({ length: Math.round((2 * half) / step) + 1 }, (_, i) => i * step - half);
  return along(a).flatMap((x) => along(b).map((y) => [x, y, z]));
}

// Discs at some centres, each turned about the y axis.
function splats(means, angles = means.map(() => 0)) {
  const discs = Float32Array.from(means.flatMap(() => [0.08, 0.08, THICKNESS].map(Math.log)));
  const quats = Float32Array.from(angles.flatMap((angle) => [Math.cos(angle / 2), 0, Math.sin(angle / 2), 0]));
  const logits = new Float32Array(means.length).fill(4);
  return { count: means.length, means: Float32Array.from(means.flat()), log_scales: discs, quats, logits };
}

// The splats that a rectangle in the picture covers, and those of them that are in front.
function selections(values, corners) {
  const shape = { by: "rectangle", camera: pictureOf(CAMERA), corners };
  const scene = { values, flags: new Uint8Array(values.count), settings: SETTINGS, near: NEAR };
  const front = frontOf(shape, CAMERA, scene, 1);
  const [covered, found] = [shape, { ...shape, front }].map((region) => [...members(region, values, new EditWork())]);
  return { front, covered, found };
}

const corners = ([x0, y0, x1, y1]) => [x0, y0, x1, y1].map((x, i) => (400 * x) / 3 + (i % 2 ? 199.5 : 319.5));
const SQUARE = corners([-0.45, -0.35, 0.45, 0.35]);

test("a large shape takes the far wall where it is visible, and not behind the near one", () => {
  const means = [...wall(NEAR_WALL, [0.8, 0.6]), ...wall(FAR_WALL, [1.6, 1.2])];
  const { front, found } = selections(splats(means), [-0.5, -0.5, 639.5, 399.5]);
  assert.deepEqual([front.columns, front.rows], [48, 48]);
  let [behind, beside] = [0, 0];
  for (const [i, [u, v, z]] of means.entries()) {
    const [x, y] = [u, v].map((one) => (Math.abs(one) * 3) / (3 + z)); // on the near wall's plane
    if (z === NEAR_WALL) assert.equal(found[i], 1);
    else if (x < 0.8 && y < 0.6) assert.equal(found[i], 0, `${++behind}`);
    else if (x > 1.05 || y > 0.85) assert.equal(found[i], 1, `${++beside}`);
  }
  assert.ok(behind > 100 && beside > 100);
});

test("splats just under a rough or a sloped surface belong to it", () => {
  const flat = wall(NEAR_WALL, [0.8, 0.6], 0.05);
  const rough = flat.map(([x, y, z], i) => [x, y, z + 2 * THICKNESS * ((i * 0.618034) % 1)]);
  const sloped = flat.map(([x, y, z]) => [x, y, z + 1.2 * x]);
  const back = wall(2.5, [2.5, 2]);
  for (const [surface, angle] of [
    [rough, 0],
    [sloped, -Math.atan(1.2)],
  ]) {
    const means = [...surface, ...back];
    const angles = means.map((_, i) => (i < surface.length ? angle : 0));
    const { covered, found } = selections(splats(means, angles), SQUARE);
    assert.deepEqual(
      found,
      covered.map((one, i) => (i < surface.length ? one : 0)),
    );
    assert.ok(found.includes(1) && covered.lastIndexOf(1) >= surface.length);
  }
});

test("a front is small, and where there is no surface it has no limit", () => {
  const values = splats([...wall(NEAR_WALL, [0.3, 0.3]), [1.2, 0, 2]]);
  values.logits[values.count - 1] = -3; // faint
  const { front, found } = selections(values, corners([-1.2, -0.5, 1.2, 0.5]));
  assert.ok(front.deepest.includes(null) && found.every((one) => one));
  assert.equal(front.deepest.length, front.columns * front.rows);
  for (const depth of front.deepest) assert.ok(depth === null || String(depth).length <= 7, `${depth}`);
});

test("the surface of the grid is that of a click", () => {
  const data = vectors("sample");
  const some = Array.from({ length: 600 }, (_, i) => i);
  const of = (name, width) => Float32Array.from(arrayOf(data[name]).subarray(0, width * some.length));
  const quats = Float32Array.from(some.flatMap((i) => [1, Math.sin(i), Math.cos(2 * i), Math.sin(3 * i)]));
  const logits = Float32Array.from(some, (i) => 4 * Math.sin(5 * i));
  const values = { count: some.length, means: of("means", 3), log_scales: of("log_scales", 3), quats, logits };
  const [flags, camera] = [new Uint8Array(values.count), { ...CAMERA, fx: 300, fy: 280 }];
  const lattice = { u0: 230, v0: 120, du: 11, dv: 9, across: 17, down: 18 };
  const { depths, ends } = visibleSurface({ values, flags, settings: SETTINGS, near: NEAR }, camera, lattice);
  const places = [...depths.keys()].map((k) => [230 + 11 * (k % 17), 120 + 9 * Math.floor(k / 17)]);
  const clicks = places.map(([u, v]) => depthAtPixel(values, flags, camera, SETTINGS, u, v, NEAR) ?? 0);
  assertClose([...depths], clicks, { relative: 1e-12 });
  const seen = depths.filter((depth) => depth > 0).length;
  assert.ok(seen > 20 && seen < depths.length - 5, `${seen}`);
  assert.ok(ends.every((end, k) => depths[k] === 0 || end > depths[k]));
});

test("a ray meets a mesh where NumPy says", () => {
  const { positions, faces, eye, directions, depths } = vectors("mesh-rays");
  const mesh = { positions: arrayOf(positions), faces: faces.flat() };
  for (const [i, direction] of directions.entries()) {
    const found = rayMeets(mesh, eye, direction, NEAR);
    if (depths[i] === null) assert.equal(found, Infinity);
    else assertClose(found, depths[i], { relative: 1e-9 });
  }
  const hits = depths.filter((depth) => depth !== null).length;
  assert.ok(hits > 100 && hits < depths.length, `${hits}`);
});

// Start points: from a PLY, or random ones where photos overlap.

import { sceneExtent } from "./engine.js";
import { Bytes, CaptureError } from "./reading.js";
import { C0 } from "./recipe.js";

const READ = {
  char: "i8",
  uchar: "u8",
  short: "i16",
  ushort: "u16",
  int: "i32",
  uint: "u32",
  float: "f32",
  double: "f64",
  int8: "i8",
  uint8: "u8",
  int16: "i16",
  uint16: "u16",
  int32: "i32",
  uint32: "u32",
  float32: "f32",
  float64: "f64",
};
const SIZES = { i8: 1, u8: 1, i16: 2, u16: 2, i32: 4, u32: 4, f32: 4, f64: 8 };
const FULL = { u8: 255, u16: 65535 }; // full brightness of integer colours
const HEADER = 1 << 16;

export const RANDOM_POINTS = 50_000;
const NEAREST = 1; // range of depths, as multiples of the scene's size; see gsplat_edu/data/visible_cloud.py
const FARTHEST = 5;
const LEAST_VIEWS = 2;
const TRIES = 40;
const PARALLEL = 1e-3; // of the smallest eigenvalue: below it, the cameras' axes do not meet

// The points of a PLY with x y z, and colours from 0 to 1: red green blue, f_dc_0..2, or grey.
export function pointsOfPly(buffer, path) {
  const { format, elements, start } = headerOf(buffer, path);
  const at = elements.findIndex(({ names }) => ["x", "y", "z"].every((name) => names.includes(name)));
  if (at < 0) throw new CaptureError(`${path} has no points with x, y and z: export it again.`);
  if (elements.slice(0, at + 1).some(({ lists }) => lists)) {
    throw new CaptureError(
      `${path} has lists before its points, which this page cannot read: export the points alone.`,
    );
  }
  const { names, kinds, count } = elements[at];
  const rows = format === "ascii" ? rowsOfText : rowsOfBytes;
  const points = new Float64Array(3 * count);
  const colors = new Float64Array(3 * count).fill(0.5);
  const color = colorColumns(names, kinds);
  const place = ["x", "y", "z"].map((name) => names.indexOf(name));
  rows(buffer, path, { format, elements, start, at }, (row, i) => {
    for (let c = 0; c < 3; ++c) {
      points[3 * i + c] = row[place[c]];
      if (color) colors[3 * i + c] = Math.min(1, Math.max(0, color[c](row)));
    }
  });
  return { points, colors };
}

function headerOf(buffer, path) {
  const text = new TextDecoder("latin1").decode(new Uint8Array(buffer, 0, Math.min(HEADER, buffer.byteLength)));
  const end = text.match(/\nend_header\r?\n/);
  const format = text.match(/^ply\r?\n(?:comment.*\n|obj_info.*\n)*format (\S+) 1\.0\r?\n/)?.[1];
  const known = ["ascii", "binary_little_endian", "binary_big_endian"];
  if (!end || !known.includes(format)) throw new CaptureError(`${path} is not a PLY file: export the points again.`);
  const elements = [];
  for (const line of text.slice(0, end.index).split("\n")) {
    const [word, kind, name] = line.trim().split(/\s+/);
    if (word === "element") elements.push({ count: Number(name), names: [], kinds: [], lists: false });
    if (word !== "property") continue;
    const element = elements.at(-1);
    if (kind === "list") element.lists = true;
    else if (!READ[kind]) throw new CaptureError(`${path} has numbers of the unknown type ${kind}: export it again.`);
    element.names.push(kind === "list" ? "" : name);
    element.kinds.push(READ[kind]);
  }
  return { format, elements, start: end.index + end[0].length };
}

function colorColumns(names, kinds) {
  const of = (wanted, value) => {
    const found = wanted.map((name) => names.indexOf(name));
    return found.every((at) => at >= 0) && found.map((at) => (row) => value(row[at], kinds[at]));
  };
  return (
    of(["red", "green", "blue"], (value, kind) => value / (FULL[kind] ?? 1)) ||
    of(["f_dc_0", "f_dc_1", "f_dc_2"], (value) => 0.5 + C0 * value)
  );
}

function rowsOfBytes(buffer, path, { format, elements, start, at }, take) {
  const bytes = new Bytes(buffer, path, format === "binary_little_endian");
  const size = ({ kinds }) => kinds.reduce((sum, kind) => sum + SIZES[kind], 0);
  bytes.skip(start + elements.slice(0, at).reduce((sum, element) => sum + element.count * size(element), 0));
  const { count, kinds } = elements[at];
  if (!(count * size(elements[at]) <= bytes.left)) bytes.skip(Number.POSITIVE_INFINITY);
  for (let i = 0; i < count; ++i) {
    take(
      kinds.map((kind) => bytes[kind]()),
      i,
    );
  }
}

function rowsOfText(buffer, path, { elements, start, at }, take) {
  const lines = new TextDecoder("latin1").decode(new Uint8Array(buffer, start)).split("\n");
  const above = elements.slice(0, at).reduce((sum, { count }) => sum + count, 0);
  const { count, names } = elements[at];
  for (let i = 0; i < count; ++i) {
    const row = (lines[above + i] ?? "").trim().split(/\s+/).map(Number);
    if (row.length !== names.length || row.some(Number.isNaN)) {
      throw new CaptureError(`${path} is truncated or damaged at point ${i + 1}: copy it again.`);
    }
    take(row, i);
  }
}

// Numbers from 0 to 1, the same for a seed on every computer: a linear congruential generator whose state is mixed.
// Source of the multipliers: Steele and Vigna 2021, "Computationally easy, spectrally good multipliers".
export function randomOf(seed) {
  let state = seed >>> 0;
  return () => {
    state = (Math.imul(state, 0x915f77f5) + 1) >>> 0;
    let mixed = state ^ (state >>> 16);
    mixed = Math.imul(mixed, 0x93d765dd);
    mixed ^= mixed >>> 15;
    return (mixed >>> 0) / 2 ** 32;
  };
}

const toCamera = ({ R, eye }, p) => {
  const d = [p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]];
  return [0, 3, 6].map((row) => R[row] * d[0] + R[row + 1] * d[1] + R[row + 2] * d[2]);
};

// Whether a point lies in the image of a camera.
export function shows(camera, point) {
  const [x, y, z] = toCamera(camera, point);
  const [u, v] = [(camera.fx * x) / z + camera.cx, (camera.fy * y) / z + camera.cy];
  return z > 0 && u >= 0 && v >= 0 && u <= camera.W - 1 && v <= camera.H - 1;
}

// Random points that at least two of the cameras show, with random colours. Each lies on the ray of a random pixel, at a
// depth whose inverse is uniform.
export function randomPoints(cameras, seed = 0, most = RANDOM_POINTS) {
  const random = randomOf(seed);
  const size = sizeOf(cameras);
  const least = Math.min(LEAST_VIEWS, cameras.length);
  const points = [];
  for (let i = 0; i < TRIES * most && points.length < 3 * most; ++i) {
    const camera = cameras[i % cameras.length];
    const z = 1 / (1 / (FARTHEST * size) + random() * (1 / (NEAREST * size) - 1 / (FARTHEST * size)));
    const x = ((random() * (camera.W - 1) - camera.cx) / camera.fx) * z;
    const y = ((random() * (camera.H - 1) - camera.cy) / camera.fy) * z;
    const { R, eye } = camera;
    const point = [0, 1, 2].map((c) => R[c] * x + R[3 + c] * y + R[6 + c] * z + eye[c]);
    let seen = 0;
    for (let k = 0; k < cameras.length && seen < least; ++k) seen += shows(cameras[k], point);
    if (seen >= least) points.push(...point);
  }
  if (!points.length) {
    throw new CaptureError("No two photos show the same place: check the poses, or add a file with points.");
  }
  return { points: Float64Array.from(points), colors: Float64Array.from(points, random) };
}

// The distance to what most cameras look at, but at least the extent of the cameras.
function sizeOf(cameras) {
  const mean = [0, 1, 2].map((c) => cameras.reduce((sum, { eye }) => sum + eye[c], 0) / cameras.length);
  const extent = sceneExtent(cameras);
  const focus = nearestToAxes(cameras, mean);
  if (!focus) return extent;
  const depths = cameras.map((camera) => toCamera(camera, focus)[2]).sort((a, b) => a - b);
  const middle = depths.length >> 1;
  return Math.max(extent, (depths[middle] + depths[(depths.length - 1) >> 1]) / 2);
}

// The point nearest to the optical axes in the least-squares sense; null if they are nearly parallel.
function nearestToAxes(cameras, mean) {
  const A = new Float64Array(9);
  const b = [0, 0, 0];
  for (const { R, eye } of cameras) {
    const d = R.slice(6);
    for (let i = 0; i < 3; ++i) {
      for (let j = 0; j < 3; ++j) {
        const across = ((i === j) - d[i] * d[j]) / cameras.length;
        A[3 * i + j] += across;
        b[i] += across * (eye[j] - mean[j]);
      }
    }
  }
  const minor = (i, j) => {
    const [r, s] = [0, 1, 2].filter((k) => k !== i);
    const [p, q] = [0, 1, 2].filter((k) => k !== j);
    return (A[3 * r + p] * A[3 * s + q] - A[3 * r + q] * A[3 * s + p]) * ((i + j) % 2 ? -1 : 1);
  };
  const det = A[0] * minor(0, 0) + A[1] * minor(0, 1) + A[2] * minor(0, 2);
  if (det < PARALLEL) return null; // no eigenvalue exceeds 1, so the smallest one is at least the determinant
  return mean.map((value, i) => value + (minor(0, i) * b[0] + minor(1, i) * b[1] + minor(2, i) * b[2]) / det);
}

// COLMAP's sparse models, binary and text; the twin of gsplat_edu/data/colmap.py.
// Source: COLMAP's documentation, "Output Format" and "Camera Models".

import { NAMES } from "./lens.js";
import { Bytes, CaptureError, folderOf, joined, ordered, wordsOf } from "./reading.js";

const MODELS = [
  ["SIMPLE_PINHOLE", "f cx cy"],
  ["PINHOLE", "fx fy cx cy"],
  ["SIMPLE_RADIAL", "f cx cy k1"],
  ["RADIAL", "f cx cy k1 k2"],
  ["OPENCV", "fx fy cx cy k1 k2 p1 p2"],
  ["OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"],
  ["FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"],
  ["FOV", "fx fy cx cy omega"],
  ["SIMPLE_RADIAL_FISHEYE", "f cx cy k1"],
  ["RADIAL_FISHEYE", "f cx cy k1 k2"],
  ["THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"],
  ["RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"],
  ["SIMPLE_DIVISION", "f cx cy k"],
  ["DIVISION", "fx fy cx cy k"],
  ["SIMPLE_FISHEYE", "f cx cy"],
  ["FISHEYE", "fx fy cx cy"],
  ["EUCM", "fx fy cx cy alpha beta"],
  ["EQUIRECTANGULAR", "w h"],
].map(([name, parameters]) => ({ name, parameters: parameters.split(" ") })); // by their numbers

const PERSPECTIVE = new Set(["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"]);
const UNIT_SLACK = 1e-3; // largest distance from 1 of the length of a quaternion that marks a line as an image's

// Folders with a model: those that have both cameras and images.
export function modelsIn(paths) {
  const known = new Set(paths);
  const folders = paths.filter((path) => /(^|\/)images\.(bin|txt)$/.test(path)).map(folderOf);
  const has = (folder, suffix) => ["cameras", "images"].every((part) => known.has(joined(folder, part + suffix)));
  return [...new Set(folders)].sort(ordered).flatMap((folder) => {
    const suffix = [".bin", ".txt"].find((ending) => has(folder, ending));
    return suffix ? [{ folder, suffix }] : [];
  });
}

// The cameras and images of a model: [{name, lens, R, eye}], in the order of its file.
export async function readModel({ folder, suffix }, read) {
  const [cameras, images] = ["cameras", "images"].map((part) => joined(folder, part + suffix));
  const rows = suffix === ".bin" ? camerasBin : camerasTxt;
  const listed = suffix === ".bin" ? imagesBin : imagesTxt;
  const known = new Map(rows(await read(cameras), cameras).map((camera) => [camera.number, camera]));
  const lenses = new Map();
  return listed(await read(images), images).map(({ name, camera, quat, shift }) => {
    if (!known.has(camera)) {
      throw new CaptureError(`${images} names a camera that ${cameras} lacks: copy the whole model again.`);
    }
    if (!lenses.has(camera)) lenses.set(camera, lensOf(known.get(camera)));
    const R = rotationOf(quat);
    const eye = [0, 1, 2].map((i) => -(R[i] * shift[0] + R[3 + i] * shift[1] + R[6 + i] * shift[2]));
    return { name, lens: lenses.get(camera), R, eye };
  });
}

// How many images the model's file lists.
export async function imagesOf({ folder, suffix }, read) {
  const path = joined(folder, `images${suffix}`);
  const buffer = await read(path);
  return suffix === ".bin" ? new Bytes(buffer, path).u64() : imagesTxt(buffer, path).length;
}

// The points of a model and their colours from 0 to 1; null if it has none.
export async function readPoints({ folder }, paths, read) {
  const path = [".bin", ".txt"].map((ending) => joined(folder, `points3D${ending}`)).find((one) => paths.has(one));
  if (!path) return null;
  const rows = (path.endsWith(".bin") ? pointsBin : pointsTxt)(await read(path), path);
  if (!rows.length) return null;
  const points = Float64Array.from(rows.flatMap((row) => row.slice(0, 3)));
  return { points, colors: Float64Array.from(rows.flatMap((row) => row.slice(3).map((value) => value / 255))) };
}

function camerasBin(buffer, path) {
  const bytes = new Bytes(buffer, path);
  return Array.from({ length: bytes.count(24) }, () => {
    const [number, kind, W, H] = [bytes.u32(), bytes.i32(), bytes.u64(), bytes.u64()];
    if (!MODELS[kind]) throw unsupported(`number ${kind}`);
    const { name: model, parameters } = MODELS[kind];
    return { number, model, W, H, values: bytes.doubles(parameters.length), path };
  });
}

function camerasTxt(buffer, path) {
  return [...wordsOf(buffer)].map(({ number: line, words: [number, model, W, H, ...values] }) => {
    const known = MODELS.find(({ name }) => name === model);
    if (H === undefined) throw malformed(path, line);
    if (!known) throw unsupported(model);
    if (known.parameters.length !== values.length) throw malformed(path, line);
    return { number: Number(number), model, W: Number(W), H: Number(H), values: values.map(Number), path };
  });
}

function imagesBin(buffer, path) {
  const bytes = new Bytes(buffer, path);
  return Array.from({ length: bytes.count(73) }, () => {
    bytes.skip(4);
    const [quat, shift, camera, name] = [bytes.doubles(4), bytes.doubles(3), bytes.u32(), bytes.word()];
    bytes.skip(24 * bytes.u64());
    return { name: name.replaceAll("\\", "/"), camera, quat, shift };
  });
}

// COLMAP writes a line of points after each image. Some programs leave it out, so such a line counts only if it reads as one.
function imagesTxt(buffer, path) {
  const found = [];
  let isAfterImage = false;
  for (const { number, line, words } of wordsOf(buffer)) {
    if (isAfterImage && arePoints(words) && !isImage(words)) {
      isAfterImage = false;
      continue;
    }
    const values = words.slice(1, 8).map(Number);
    const name = line.match(/^(?:\S+\s+){9}(.*)$/)?.[1];
    if (!name || !values.every(Number.isFinite)) throw malformed(path, number);
    const [quat, shift] = [values.slice(0, 4), values.slice(4)];
    found.push({ name: name.replaceAll("\\", "/"), camera: Number(words[8]), quat, shift });
    isAfterImage = true;
  }
  return found;
}

const arePoints = (words) =>
  words.length % 3 === 0 && words.every((word, i) => (i % 3 < 2 ? !Number.isNaN(Number(word)) : /^-?\d+$/.test(word)));

const isImage = (words) =>
  words.length > 9 &&
  /^\d+$/.test(words[0]) &&
  /^\d+$/.test(words[8]) &&
  Math.abs(Math.hypot(...words.slice(1, 5).map(Number)) - 1) < UNIT_SLACK;

function pointsBin(buffer, path) {
  const bytes = new Bytes(buffer, path);
  return Array.from({ length: bytes.count(51) }, () => {
    bytes.skip(8);
    const row = [...bytes.doubles(3), bytes.u8(), bytes.u8(), bytes.u8()];
    bytes.skip(8);
    bytes.skip(8 * bytes.u64());
    return row;
  });
}

function pointsTxt(buffer, path) {
  return [...wordsOf(buffer)].map(({ number, words }) => {
    const row = words.slice(1, 7).map(Number);
    if (words.length < 8 || row.some(Number.isNaN)) throw malformed(path, number);
    return row;
  });
}

// The lens of a camera whose first pixel has its centre at (0.5, 0.5).
function lensOf({ model, W, H, values, path }) {
  if (!PERSPECTIVE.has(model)) throw unsupported(model);
  const { parameters } = MODELS.find(({ name }) => name === model);
  const { f, fx = f, fy = f, cx, cy, ...rest } = Object.fromEntries(parameters.map((name, i) => [name, values[i]]));
  const lens = { W, H, fx, fy, cx: cx - 0.5, cy: cy - 0.5, coefficients: NAMES.map((name) => rest[name] ?? 0) };
  return checkedLens(lens, path);
}

// Returns a lens whose numbers can be those of a camera.
export function checkedLens(lens, path) {
  const { W, H, fx, fy, cx, cy, coefficients } = lens;
  const isSize = [W, H].every((side) => Number.isInteger(side) && side >= 1 && side <= 2 ** 20);
  if (isSize && fx > 0 && fy > 0 && [fx, fy, cx, cy, ...coefficients].every(Number.isFinite)) return lens;
  throw new CaptureError(`${path} describes a camera with impossible numbers: export it again.`);
}

// The rotation of a quaternion (w, x, y, z), row by row.
function rotationOf(quat) {
  const length = Math.hypot(...quat);
  const [w, x, y, z] = quat.map((value) => value / length);
  return [
    ...[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    ...[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    ...[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

const malformed = (path, line) => new CaptureError(`${path}, line ${line} is malformed: export the model again.`);

export const unsupported = (model) =>
  new CaptureError(
    `This page cannot undistort photos of the camera model ${model}: run "colmap image_undistorter" and drop the result, ` +
      "or train with gsplat-edu train.",
  );

// transforms.json of nerfstudio and instant-ngp; the twin of gsplat_edu/data/transforms.py.
// Source: nerfstudio's documentation, "Data conventions"; instant-ngp's "nerf_dataset_tips".

import { checkedLens, unsupported } from "./colmap.js";
import { NAMES } from "./lens.js";
import { CaptureError, parsedJson, tidy } from "./reading.js";

const MODELS = new Set(["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"]);
const FOCAL = { x: ["fl_x", "camera_angle_x"], y: ["fl_y", "camera_angle_y"] };
const INTRINSICS = new Set(["w", "h", "cx", "cy", "camera_model", "is_fisheye", ...NAMES, ...FOCAL.x, ...FOCAL.y]);

// The frames of a file, [{name, values, R, eye, part, where}], and the path of its points or null. `lensFor` makes a lens of
// a frame's values, which may lack a size.
export function readTransforms(buffer, path) {
  const contents = stated(parsedJson(buffer, path));
  if (!Array.isArray(contents.frames)) throw new CaptureError(`${path} has no list of frames: export it again.`);
  const parts = partsOf(contents, path);
  const shared = only(contents);
  const frames = contents.frames.map((given, i) => {
    const frame = stated(given ?? {});
    const where = `${path}, frame ${i}`;
    if (typeof frame.file_path !== "string") throw new CaptureError(`${where} has no file_path: export it again.`);
    const name = tidy(frame.file_path);
    const values = merged(shared, only(frame));
    const model = values.is_fisheye === true ? "OPENCV_FISHEYE" : (values.camera_model ?? "OPENCV");
    if (!MODELS.has(model)) throw unsupported(model);
    const part = parts.has(name) ? parts.get(name) : parts.get("");
    return { name, values, ...poseOf(frame.transform_matrix, where), part, where };
  });
  const points = typeof contents.ply_file_path === "string" ? tidy(contents.ply_file_path) : null;
  return { frames: eachOnce(frames, path), points };
}

// The lens of a frame. W, H: size of its photo, which counts where no size is given.
export function lensFor({ values, where }, W, H) {
  const [w, h] = values.w !== undefined && values.h !== undefined ? [values.w, values.h] : [W, H];
  const fx = focal(values, "x", w);
  if (fx === undefined) {
    throw new CaptureError(`${where} has neither fl_x nor camera_angle_x: add one of them to the file.`);
  }
  const { cx = w / 2, cy = h / 2 } = values;
  const coefficients = NAMES.map((name) => values[name] ?? 0);
  const lens = { W: w, H: h, fx, fy: focal(values, "y", h) ?? fx, cx: cx - 0.5, cy: cy - 0.5, coefficients };
  return checkedLens(lens, where);
}

// null counts as missing.
const stated = (values) => Object.fromEntries(Object.entries(values).filter(([, value]) => value !== null));

const only = (values) => Object.fromEntries(Object.entries(values).filter(([key]) => INTRINSICS.has(key)));

// A frame's numbers, completed with the file's. A focal length in x of the frame replaces all of the file's.
function merged(shared, own) {
  const has = (axis) => FOCAL[axis].some((key) => key in own);
  const dropped = has("x") ? [...FOCAL.x, ...FOCAL.y] : has("y") ? FOCAL.y : [];
  return { ...Object.fromEntries(Object.entries(shared).filter(([key]) => !dropped.includes(key))), ...own };
}

// A focal length, px; from a field of view: f = size / (2 tan(angle / 2)).
function focal(values, axis, size) {
  const [length, angle] = FOCAL[axis];
  if (values[length] !== undefined) return values[length];
  return values[angle] === undefined ? undefined : size / (2 * Math.tan(values[angle] / 2));
}

// From camera to world in OpenGL's axes, to a rotation from world to camera in OpenCV's, and the camera's centre.
function poseOf(matrix, where) {
  const rows = Array.isArray(matrix) && [3, 4].includes(matrix.length) ? matrix : [];
  const numbers = rows.every((row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite));
  if (!rows.length || !numbers) {
    throw new CaptureError(`${where} has no transform_matrix of 3 x 4 or 4 x 4 numbers: export the file again.`);
  }
  const R = [1, -1, -1].flatMap((sign, i) => [0, 1, 2].map((j) => sign * rows[j][i]));
  return { R, eye: [0, 1, 2].map((i) => rows[i][3]) };
}

// The part of each listed name, and under "" that of all others.
function partsOf(contents, path) {
  const [train, val, test] = ["train", "val", "test"].map((part) => {
    const names = contents[`${part}_filenames`] ?? [];
    if (Array.isArray(names) && names.every((name) => typeof name === "string")) return names.map(tidy);
    throw new CaptureError(`${path} has a ${part}_filenames that is no list of names: repair or remove it.`);
  });
  const heldOut = test.length ? test : val;
  const rest = train.length ? "left out" : heldOut.length ? "train" : "";
  const parts = new Map([["", rest], ...val.map((name) => [name, "left out"])]);
  for (const name of heldOut) parts.set(name, "test");
  for (const name of train) parts.set(name, "train");
  return parts;
}

// Frames with each photo once; entries that differ are an error.
function eachOnce(frames, path) {
  const known = new Map();
  for (const frame of frames) {
    const same = known.get(frame.name);
    if (!same) known.set(frame.name, frame);
    else if (JSON.stringify([same.R, same.eye, same.values]) !== JSON.stringify([frame.R, frame.eye, frame.values])) {
      throw new CaptureError(`${path} lists ${frame.name} twice with different cameras: remove one of the entries.`);
    }
  }
  return [...known.values()];
}

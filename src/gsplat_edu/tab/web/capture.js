// A capture among dropped files: photos with poses, found by what the files contain; the twin of gsplat_edu/data.

import { imagesOf, modelsIn, readModel, readPoints } from "./colmap.js";
import { CaptureError, folderOf, joined, nameOf, ordered } from "./reading.js";
import { pointsOfPly } from "./points.js";
import { readTransforms } from "./transforms.js";

const PHOTO = /\.(png|jpe?g|webp|avif|gif|bmp|tiff?|hei[cf]|hif)$/i;
const HIDDEN = /(^|\/)(\.[^/]*|__MACOSX|Thumbs\.db|desktop\.ini)(\/|$)/i;
const OTHER = /(^|\/)(masks?|depths?|images_[248]|thumbnails?)\//i; // folders whose images are not the photos of that name
const TEST_EVERY = 8; // hold out every 8th view if the capture defines no split (the usual convention)
const ONE_PLACE = 1e-5; // largest distance of two centres that count as one, as a fraction of the cameras' spread
const ROTATION_SLACK = 1e-2;
const MAX_COORDINATE = 1e12;
const COPIES = ["images_2", "images_4", "images_8"];

// Reads the capture in a list of {path, file}; a file is a Blob, or has its arrayBuffer(). Returns
// {layout, frames, cloud, notes}: frames {name, path, file, R, eye, part} sorted by name, with the `lens` of COLMAP or what
// `lensFor` makes one from; cloud {points, colors} or null; notes are sentences.
// Raises CaptureError.
export async function readCapture(files) {
  const known = new Map(files.filter(({ path }) => !HIDDEN.test(path)).map(({ path, file }) => [path, file]));
  const read = (path) => known.get(path).arrayBuffer();
  const paths = [...known.keys()].sort(ordered);
  const json = paths
    .filter((path) => nameOf(path) === "transforms.json")
    .sort((one, other) => one.split("/").length - other.split("/").length)[0];
  const models = json ? [] : modelsIn(paths);
  if (!json && !models.length) throw nothing(paths);
  const found = json ? await fromTransforms(json, known, read) : await fromColmap(models, known, read);
  const photos = new Photos(paths);
  const frames = found.frames.map((frame) => ({ ...frame, path: photos.find(found.folder, frame.name) }));
  const there = frames.filter(({ path }) => path);
  if (!there.length) {
    throw new CaptureError(
      `None of the ${frames.length} photos is here, first ${frames[0]?.name}: drop the photos with it.`,
    );
  }
  const notes = [];
  if (there.length < frames.length) {
    const first = frames.find(({ path }) => !path).name;
    notes.push(`${frames.length - there.length} of ${frames.length} photos are missing, first ${first}.`);
  }
  if (paths.some((path) => /(^|\/)masks?\//i.test(path))) notes.push("Masks are not used here.");
  const sorted = usable(there, notes).sort((one, other) => ordered(one.name, other.name));
  checkSingle(sorted);
  const split = partsOf(sorted);
  const placed = sorted.map((frame, i) => ({ ...frame, part: split[i], file: known.get(frame.path) }));
  return { layout: found.layout, frames: placed, cloud: finite(found.cloud), notes };
}

async function fromTransforms(path, known, read) {
  const { frames, points } = readTransforms(await read(path), path);
  const ply = points === null ? undefined : joined(folderOf(path), points);
  const cloud = known.has(ply) ? pointsOfPly(await read(ply), ply) : null;
  return { layout: "transforms.json", folder: folderOf(path), frames, cloud };
}

// Of several models, the one with the most images counts.
async function fromColmap(models, known, read) {
  const counts = await Promise.all(models.map((model) => imagesOf(model, read)));
  const model = models[counts.indexOf(Math.max(...counts))];
  const frames = await readModel(model, read);
  if (!frames.length)
    throw new CaptureError(`${joined(model.folder, "images")} lists no photos: find the poses again.`);
  return { layout: "COLMAP", folder: model.folder, frames, cloud: await readPoints(model, known, read) };
}

function nothing(paths) {
  const photos = paths.filter((path) => PHOTO.test(path)).length;
  if (paths.some((path) => nameOf(path) === "transforms_train.json")) {
    return new CaptureError("Captures of Blender (transforms_train.json) are not read here: use gsplat-edu train.");
  }
  if (!photos)
    return new CaptureError("There are no photos here: drop a folder or zip file with photos and their poses.");
  return new CaptureError(
    `There are ${photos} photos, but no camera poses: run "gsplat-edu sfm" on them, and drop the folder that it writes.`,
  );
}

// Finds photos by the names that a capture gives them. paths: all files, sorted.
class Photos {
  constructor(paths) {
    const photos = paths.filter((path) => PHOTO.test(path));
    this.exact = new Map();
    this.folded = new Map();
    this.names = new Map();
    this.stems = new Map();
    for (const path of photos) {
      this.exact.set(path, path);
      for (const key of [folded(path), folded(stemOf(path))]) if (!this.folded.has(key)) this.folded.set(key, path);
      if (OTHER.test(path)) continue;
      push(this.names, folded(nameOf(path)), path);
      push(this.stems, folded(stemOf(nameOf(path))), path);
    }
  }

  // The path of a photo; null if it is not there. folder: where the poses are.
  find(folder, name) {
    const places = [];
    for (let above = folder; ; above = folderOf(above)) {
      places.push(joined(above, `images/${name}`), joined(above, name));
      if (!above) break;
    }
    const copies = places.flatMap((place) => COPIES.map((copy) => place.replace(/(^|\/)images\//, `$1${copy}/`)));
    const exact = places.find((place) => this.exact.has(place));
    const near = [...places, ...copies].map((place) => this.folded.get(folded(place))).find(Boolean);
    const alone = [this.names.get(folded(nameOf(name))), this.stems.get(folded(stemOf(nameOf(name))))];
    return exact ?? near ?? alone.find((some) => some?.length === 1)?.[0] ?? null;
  }
}

const folded = (name) => name.normalize("NFC").toLowerCase();

const stemOf = (path) => path.replace(PHOTO, "");

const push = (lists, key, value) => lists.set(key, [...(lists.get(key) ?? []), value]);

function checkSingle(frames) {
  const owners = new Map();
  for (const { name, path } of frames) {
    if (owners.has(path)) {
      throw new CaptureError(`${path} is the photo of both ${owners.get(path)} and ${name}: put each at its own path.`);
    }
    owners.set(path, name);
  }
}

// Leaves out frames whose pose is none, and says so.
function usable(frames, notes) {
  const good = frames.filter(({ R, eye }) => eye.every((value) => Math.abs(value) < MAX_COORDINATE) && isRotation(R));
  if (!good.length) throw new CaptureError("No photo has a usable pose: find the poses again.");
  const bad = frames.find((frame) => !good.includes(frame));
  if (bad)
    notes.push(`${frames.length - good.length} of ${frames.length} photos have an impossible pose, first ${bad.name}.`);
  return good.map((frame) => ({ ...frame, R: nearestRotation(frame.R) }));
}

// The rotation nearest to a matrix that was written with few digits, in the least-squares sense: the mean of the matrix and
// its inverse transpose, repeated, keeps the singular vectors and brings the singular values to 1, twice the digits each time.
function nearestRotation(R) {
  let nearest = R;
  for (let step = 0; step < 6; ++step) {
    const [a, b, c, d, e, f, g, h, i] = nearest;
    const cofactors = [e * i - f * h, f * g - d * i, d * h - e * g, c * h - b * i, a * i - c * g, b * g - a * h];
    cofactors.push(b * f - c * e, c * d - a * f, a * e - b * d);
    const det = a * cofactors[0] + b * cofactors[1] + c * cofactors[2];
    nearest = nearest.map((value, k) => (value + cofactors[k] / det) / 2);
  }
  return nearest;
}

function isRotation(R) {
  const dot = (i, j) => R[3 * i] * R[3 * j] + R[3 * i + 1] * R[3 * j + 1] + R[3 * i + 2] * R[3 * j + 2];
  const pairs = [0, 1, 2].flatMap((i) => [0, 1, 2].map((j) => Math.abs(dot(i, j) - (i === j))));
  const [a, b, c, d, e, f, g, h, i] = R;
  const det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
  return pairs.every((error) => error <= ROTATION_SLACK) && det > 0;
}

// "train", "test" or "left out" for each frame, sorted by name: every 8th camera position is held out unless the capture
// says otherwise; a capture of one photo holds out none.
export function partsOf(frames) {
  if (frames.some(({ part }) => part)) {
    if (frames.some(({ part }) => part === "train")) return frames.map(({ part }) => part);
    throw new CaptureError("The capture's own lists leave no photo for training: remove test_filenames.");
  }
  if (frames.length === 1) return ["train"];
  let places = placesOf(frames.map(({ eye }) => eye));
  if (Math.max(...places) === 0) places = frames.map((_, i) => i);
  return places.map((place) => (place % TEST_EVERY ? "train" : "test"));
}

// Numbers camera centres in the order in which they occur; centres as good as equal have one number.
function placesOf(eyes) {
  const mean = [0, 1, 2].map((c) => eyes.reduce((sum, eye) => sum + eye[c], 0) / eyes.length);
  const away = (one, other) => Math.hypot(one[0] - other[0], one[1] - other[1], one[2] - other[2]);
  const near = ONE_PLACE * Math.max(...eyes.map((eye) => away(eye, mean)));
  const first = [];
  return eyes.map((eye) => {
    const at = first.findIndex((other) => away(eye, other) <= near);
    return at < 0 ? first.push(eye) - 1 : at;
  });
}

// Points without those that are NaN, infinite or absurdly far away.
function finite(cloud) {
  if (!cloud) return null;
  const { points, colors } = cloud;
  const good = (_, i) => {
    const row = i - (i % 3);
    return [0, 1, 2].every((c) => Math.abs(points[row + c]) < MAX_COORDINATE);
  };
  return { points: points.filter(good), colors: colors.filter(good) };
}

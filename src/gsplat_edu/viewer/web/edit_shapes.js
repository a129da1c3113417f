// Geometry of the editor: cameras, boxes and lines as an edits file describes them.

import { SELECTED } from "./edit_flags.js";
import { cross, dot, plus, transposed, unit } from "./vectors.js";

export const EDIT_UP = [0, -1, 0]; // the world's up direction
const [BOX_LOW, BOX_HIGH] = [0.02, 0.98]; // quantiles of the splats that a new box encloses
export const MOST_SAMPLED = 20000; // splats that these are taken from
export const CIRCLE = 48; // corners of a drawn circle
export const HANDLE = 7; // CSS pixels: radius of a dot to take hold of
export const LEAST_DRAG = 3; // CSS pixels; a shorter drag is a click
export const MOST_STROKE = 20000; // points of a stroke, as in an edits file

export const rotated = (rows, vector) => rows.map((row) => dot(row, vector)); // rows of a matrix times a vector
export const hundredths = (x) => Math.round(x * 100) / 100;
export const length3 = (a) => Math.hypot(...a);

// The camera of a picture as a "select" stores it.
export function pictureOf({ R, eye, fx, fy, cx, cy, W, H }) {
  return { position: [...eye], rotation: transposed(R), fx, fy, cx, cy, width: W, height: H };
}

// A view as "start" and "view" store it.
export function storedView({ R, eye, H, fy }) {
  return { position: [...eye], rotation: transposed(R), fov: (2 * Math.atan((0.5 * H) / fy) * 180) / Math.PI };
}

// Column and row at which a camera sees a point, and its depth.
export function seenAt(camera, point) {
  const [x, y, z] = rotated(camera.R, plus(point, camera.eye, -1));
  return { u: (camera.fx * x) / z + camera.cx, v: (camera.fy * y) / z + camera.cy, depth: z };
}

// The part of a line in front of the camera, as two pixels; null if there is none.
export function seenLine(camera, a, b, near) {
  const [za, zb] = [a, b].map((point) => dot(camera.R[2], plus(point, camera.eye, -1)));
  if (!(za > near || zb > near)) return null;
  const cut = (from, to, zFrom, zTo) =>
    zFrom > near ? from : from.map((x, i) => x + ((near * 1.001 - zFrom) / (zTo - zFrom)) * (to[i] - x));
  return [seenAt(camera, cut(a, b, za, zb)), seenAt(camera, cut(b, a, zb, za))];
}

// Normal of the plane through three points, of length 1, counterclockwise as seen from its side.
export function normalOf([a, b, c]) {
  return unit(cross(plus(b, a, -1), plus(c, a, -1)));
}

// Shortest rotation from one direction to another; both of length 1. Opposite ones turn about the x axis.
function shortestTurn(from, to) {
  const cosine = dot(from, to);
  if (cosine < -1 + 1e-9)
    return [
      [1, 0, 0],
      [0, -1, 0],
      [0, 0, -1],
    ];
  const v = cross(from, to);
  const across = [
    [0, -v[2], v[1]],
    [v[2], 0, -v[0]],
    [-v[1], v[0], 0],
  ];
  return across.map((row, i) =>
    row.map((value, j) => {
      const square = row.reduce((sum, x, k) => sum + x * across[k][j], 0);
      return (i === j ? 1 : 0) + value + square / (1 + cosine);
    }),
  );
}

// Axes of a box that stands upright, as columns.
export function uprightAxes(up) {
  return transposed(shortestTurn(up, EDIT_UP));
}

// Where a new box starts: around what most cameras look at, unless nothing is left there, or no cameras are known.
export function newBox(values, flags, up, subject) {
  const isInside = (i) => {
    const away = plus(values.means.subarray(3 * i, 3 * i + 3), subject.center, -1);
    return transposed(subject.rotation).every((axis, j) => Math.abs(dot(axis, away)) <= subject.half[j]);
  };
  for (let i = 0; subject && i < values.count; ++i) if (flags[i] <= SELECTED && isInside(i)) return subject;
  return boxAround(values, flags, up);
}

// A box around most of the splats that are there.
function boxAround({ count, means }, flags, up) {
  const rotation = uprightAxes(up);
  const axes = transposed(rotation);
  const places = [[], [], []];
  const every = Math.max(1, Math.floor(count / MOST_SAMPLED));
  for (let i = 0; i < count; i += every) {
    const point = [means[3 * i], means[3 * i + 1], means[3 * i + 2]];
    if (flags[i] <= SELECTED && point.every(Number.isFinite))
      axes.forEach((axis, j) => places[j].push(dot(axis, point)));
  }
  if (!places[0].length) return { center: [0, 0, 0], rotation, half: [1, 1, 1] };
  const ends = places.map((list) => {
    list.sort((a, b) => a - b);
    return [BOX_LOW, BOX_HIGH].map((share) => list[Math.round(share * (list.length - 1))]);
  });
  const middle = ends.map(([low, high]) => (low + high) / 2);
  const half = ends.map(([low, high]) => Math.max(0.55 * (high - low), 1e-3));
  return { center: rotated(rotation, middle), rotation, half };
}

// Corners and edges of a box.
export function boxLines({ center, rotation, half }) {
  const axes = transposed(rotation);
  const corner = (k) => axes.reduce((at, axis, j) => plus(at, axis, k & (1 << j) ? half[j] : -half[j]), center);
  const lines = [];
  for (let k = 0; k < 8; ++k) for (const j of [1, 2, 4]) if (!(k & j)) lines.push([corner(k), corner(k | j)]);
  return lines;
}

// The middle of each side of a box, with its axis and direction.
export function boxHandles({ center, rotation, half }) {
  return transposed(rotation).flatMap((axis, j) =>
    [-1, 1].map((side) => ({ axis: j, side, direction: axis, point: plus(center, axis, side * half[j]) })),
  );
}

// Moves one side of a box by a length along its axis; the opposite side stays.
function withSideMoved(box, { axis, side, direction }, by) {
  const least = 1e-3 * Math.max(...box.half);
  const step = Math.max(side * by, 2 * (least - box.half[axis]));
  const half = box.half.map((value, j) => (j === axis ? value + step / 2 : value));
  return { ...box, half, center: plus(box.center, direction, (side * step) / 2) };
}

// The side of a box whose dot a stroke begins on; null if there is none.
export function sideAt(box, { camera, began }, perPixel, near) {
  const apart = ({ point }) => {
    const { u, v, depth } = seenAt(camera, point);
    return depth > near ? Math.hypot(u - began.u, v - began.v) / perPixel : Infinity;
  };
  const best = boxHandles(box).reduce((a, b) => (apart(a) <= apart(b) ? a : b));
  return apart(best) < 2 * HANDLE ? best : null;
}

// The box of a stroke after one of its sides was dragged, by the pixels along the side's axis as it is seen; null along
// the line of sight. `distance` is that of the view from its pivot.
export function sideDragged({ box, handle, camera, began, at }, distance) {
  const step = 1e-3 * distance;
  const [from, to] = [handle.point, plus(handle.point, handle.direction, step)].map((point) => seenAt(camera, point));
  const axis = [to.u - from.u, to.v - from.v];
  const square = axis[0] ** 2 + axis[1] ** 2;
  if (square < 1e-9) return null;
  const along = ((at.u - began.u) * axis[0] + (at.v - began.v) * axis[1]) / square;
  return withSideMoved(box, handle, along * step);
}

// Three circles around a sphere, along the axes of the view.
export function sphereLines({ center, radius }, R) {
  const lines = [];
  for (const [a, b] of [
    [0, 1],
    [1, 2],
    [0, 2],
  ]) {
    const at = (i) => {
      const angle = (2 * Math.PI * i) / CIRCLE;
      return plus(plus(center, R[a], radius * Math.cos(angle)), R[b], radius * Math.sin(angle));
    };
    for (let i = 0; i < CIRCLE; ++i) lines.push([at(i), at(i + 1)]);
  }
  return lines;
}

// Turns a camera about its line of sight until its picture is level.
export function levelled(camera, up) {
  const forward = camera.R[2];
  const right = cross(forward, up);
  if (length3(right) < 1e-3) return camera;
  const level = unit(right);
  return { ...camera, R: [level, cross(forward, level), forward] };
}

// A number as text, short.
export function shortNumber(value) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-3 ? value.toExponential(2) : String(Number(value.toPrecision(4)));
}

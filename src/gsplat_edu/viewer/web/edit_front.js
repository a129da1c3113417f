// Selections of only what is in front: the depths of the visible surface, measured once when the user draws, and their
// comparison, which is exactly that of gsplat_edu/edits/front.py.

import { ratioBounds } from "./camera.js";
import { SOLID } from "./draw.js";
import { eachSeen, extent } from "./edit_cells.js";
import { alphaAt, footprintOf, splatsWithin } from "./edit_pixel.js";
import { hundredths } from "./edit_shapes.js";

const FRONT_CELLS = 48; // cells of the stored grid along each axis, at most
const FRONT_CELL = 8; // CSS pixels: smallest side of a cell
const NARROWEST_FRONT = 1; // pixels of the picture: smallest side of the grid
const FRONT_THICKNESS = 3; // standard deviations in depth that a surface reaches beyond where it is seen
const FRONT_OPAQUE = 1e-4; // transmittance below which a pixel counts as opaque
const STEEPEST_FRONT = 6; // depth per width of a surface seen at 80 degrees; a steeper step is an edge

export const FRONT_ROW = `
<p class="row" data-for="rectangle lasso polygon brush">
<button data-do="front" aria-pressed="false" title="5: select only what is in front, not what lies behind the visible surface">front only</button>
</p>`;

// Removes the splats that lie deeper than the cells of a selection allow. inside: 1 for those that the shape holds.
export function inFront(region, values, inside, work) {
  if (!region.front) return inside;
  const {
    bounds: [u0, v0, u1, v1],
    columns,
    rows,
    deepest,
  } = region.front;
  work.add(inside.reduce((sum, one) => sum + one, 0));
  eachSeen(region, values, (i, u, v, z) => {
    if (!inside[i]) return;
    const limit = deepest[frontCell(v, v0, v1, rows) * columns + frontCell(u, u0, u1, columns)];
    if (limit !== null && !(z <= limit)) inside[i] = 0;
  });
  return inside;
}

function frontCell(value, low, high, count) {
  return Math.min(Math.max(Math.floor((value - low) * (count / (high - low))), 0), count - 1);
}

// The "front" of a selection drawn in a picture. region: its shape. scene: {values, flags, settings, near}. perPixel:
// pixels of the picture per CSS pixel.
export function frontOf(region, camera, scene, perPixel) {
  const bounds = frontBounds(region, camera);
  const [width, height] = [bounds[2] - bounds[0], bounds[3] - bounds[1]];
  const count = (length) => Math.min(Math.max(Math.ceil(length / (FRONT_CELL * perPixel)), 1), FRONT_CELLS);
  const [columns, rows] = [count(width), count(height)];
  // the corners, the middles of the sides and the middle of each cell
  const [across, down] = [2 * columns + 1, 2 * rows + 1];
  const lattice = { u0: bounds[0], v0: bounds[1], du: width / (across - 1), dv: height / (down - 1), across, down };
  const surface = visibleSurface(scene, camera, lattice);
  const deepest = [];
  for (let row = 0; row < rows; ++row) {
    for (let column = 0; column < columns; ++column) {
      const places = [0, 1, 2].flatMap((j) => [0, 1, 2].map((i) => (2 * row + j) * across + 2 * column + i));
      deepest.push(
        deepestOf(places, surface, STEEPEST_FRONT * Math.max(lattice.du / camera.fx, lattice.dv / camera.fy)),
      );
    }
  }
  return { bounds, columns, rows, deepest };
}

// Where a shape lies in the picture.
function frontBounds({ corners, points, radius = 0 }, { W, H }) {
  const [us, vs] = points
    ? [0, 1].map((axis) => extent(points.map((point) => point[axis])))
    : [
        [corners[0], corners[2]],
        [corners[1], corners[3]],
      ];
  const ends = ([low, high], most) => {
    const [from, to] = [low - radius - 0.5, high + radius + 0.5].map((x) =>
      hundredths(Math.min(Math.max(x, -0.5), most - 0.5)),
    );
    return to - from < NARROWEST_FRONT ? [from - NARROWEST_FRONT, to + NARROWEST_FRONT] : [from, to];
  };
  const [[u0, u1], [v0, v1]] = [ends(us, W), ends(vs, H)];
  return [u0, v0, u1, v1];
}

// The deepest end of the nearest surface at some places; null if there is none. steepness: step of depth between places,
// per depth, up to which they show one surface.
function deepestOf(places, { depths, ends }, steepness) {
  const found = places.filter((place) => depths[place] > 0).sort((a, b) => depths[a] - depths[b]);
  if (!found.length) return null;
  let [end, last] = [0, depths[found[0]]];
  for (const place of found) {
    if (depths[place] > Math.max(end, last * (1 + steepness))) break;
    [end, last] = [Math.max(end, ends[place]), depths[place]];
  }
  return Math.min(Number((end * 1.0001).toPrecision(5)), 1e30); // not less than the end, and allowed in a file
}

// The surface at the points of a lattice: depths, where half of the opacity is reached, as depthAtPixel finds it (0 if
// there is none), and ends, which lie deeper by the thickness of the splats up to there: three times the mean of their
// standard deviations in depth, weighted by what each adds to the opacity.
export function visibleSurface({ values, flags, settings, near }, camera, lattice) {
  const { u0, v0, du, dv, across, down } = lattice;
  const size = across * down;
  const clear = new Float64Array(size).fill(1); // transmittance
  const done = new Uint8Array(size);
  const hide = (at, alpha) => {
    clear[at] *= 1 - alpha;
    if (clear[at] < FRONT_OPAQUE) done[at] = 1;
  };
  const bounds = ratioBounds(camera, settings);
  const prints = []; // of the splats that are not hidden by others, near to far
  for (const { i, u, v, reach } of splatsWithin(
    values,
    flags,
    camera,
    [u0, v0, u0 + du * (across - 1), v0 + dv * (down - 1)],
    near,
  )) {
    if (!someLeft(placesWithin(lattice, u, v, reach, reach), done, across)) continue;
    const print = footprintOf(values, i, camera, bounds, settings.antialiased);
    if (!print) continue;
    prints.push(print);
    eachHit(print, lattice, done, hide);
  }
  const [depths, ends, spread, passed] = [0, 0, 0, 1].map((value) => new Float64Array(size).fill(value));
  for (let at = 0; at < size; ++at) done[at] = 0.5 * (1 - clear[at]) >= SOLID ? 0 : 1;
  const reach = (at, alpha, { depth, deviation }) => {
    spread[at] += passed[at] * alpha * deviation;
    passed[at] *= 1 - alpha;
    if (1 - passed[at] < 0.5 * (1 - clear[at])) return;
    depths[at] = depth;
    ends[at] = depth + (FRONT_THICKNESS * spread[at]) / (1 - passed[at]);
    done[at] = 1;
  };
  for (const print of prints) eachHit(print, lattice, done, reach);
  return { depths, ends };
}

// The columns and rows of a lattice within a distance of a place: [left, right, top, bottom].
function placesWithin({ u0, v0, du, dv, across, down }, u, v, halfU, halfV) {
  const left = Math.max(Math.ceil((u - halfU - u0) / du), 0);
  const right = Math.min(Math.floor((u + halfU - u0) / du), across - 1);
  const top = Math.max(Math.ceil((v - halfV - v0) / dv), 0);
  const bottom = Math.min(Math.floor((v + halfV - v0) / dv), down - 1);
  return [left, right, top, bottom];
}

function someLeft([left, right, top, bottom], done, across) {
  for (let row = top; row <= bottom; ++row) {
    for (let at = row * across + left; at <= row * across + right; ++at) if (!done[at]) return true;
  }
  return false;
}

// Calls found(place, alpha, footprint) for the points of a lattice that a footprint covers, and that are not done.
function eachHit(print, lattice, done, found) {
  const { u0, v0, du, dv, across } = lattice;
  const [left, right, top, bottom] = placesWithin(lattice, print.u, print.v, print.halfU, print.halfV);
  for (let row = top; row <= bottom; ++row) {
    for (let column = left; column <= right; ++column) {
      const at = row * across + column;
      if (done[at]) continue;
      const alpha = alphaAt(print, u0 + column * du, v0 + row * dv);
      if (alpha) found(at, alpha, print);
    }
  }
}

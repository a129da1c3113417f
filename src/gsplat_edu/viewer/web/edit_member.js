// Which splats a region holds: exactly the same ones as in gsplat_edu/edits/membership.py.
//
// Both sides compute with the float32 parameters as float64 numbers, by +, -, *, / and comparisons only, in the order
// written here, so both find the same splats to the last one. NaN belongs to no region.

import { Cells, EditWork, eachSeen, extent } from "./edit_cells.js";
import { inFront } from "./edit_front.js";
import { listMembers } from "./edit_near.js";

// The splats seen within bounds, as {at, u, v}: indices, columns and rows.
function seenWithin(region, values, [lowU, highU], [lowV, highV]) {
  const at = new Uint32Array(values.count);
  const us = new Float64Array(values.count);
  const vs = new Float64Array(values.count);
  let count = 0;
  eachSeen(region, values, (i, u, v) => {
    if (!(u >= lowU && u <= highU && v >= lowV && v <= highV)) return;
    at[count] = i;
    us[count] = u;
    vs[count++] = v;
  });
  return { at: at.subarray(0, count), u: us.subarray(0, count), v: vs.subarray(0, count) };
}

// Even-odd rule within the polygon's bounds: counts the edges that cross the ray towards larger u.
function lassoMembers(region, values, work) {
  const { points } = region;
  const bounds = [0, 1].map((axis) => extent(points.map((point) => point[axis])));
  const { at, u, v } = seenWithin(region, values, ...bounds);
  const cells = new Cells(u, v, work);
  const inside = new Uint8Array(values.count);
  let [ax, ay] = points.at(-1);
  for (const [bx, by] of points) {
    if (ay !== by) {
      // One more column, because the rounded crossing may lie beyond the edge's bounds.
      cells.touched(-Infinity, Math.max(ax, bx), Math.min(ay, by), Math.max(ay, by), 1, (k) => {
        if (ay > v[k] !== by > v[k] && u[k] < ((bx - ax) * (v[k] - ay)) / (by - ay) + ax) inside[at[k]] ^= 1;
      });
    }
    [ax, ay] = [bx, by];
  }
  return inside;
}

// Within the radius of a segment, and of the segment's bounds widened by the radius.
function brushMembers(region, values, work) {
  const { points, radius } = region;
  const bounds = [0, 1].map((axis) => {
    const [low, high] = extent(points.map((point) => point[axis]));
    return [low - radius, high + radius];
  });
  const { at, u, v } = seenWithin(region, values, ...bounds);
  const cells = new Cells(u, v, work);
  const inside = new Uint8Array(values.count);
  const square = radius * radius;
  let [ax, ay] = points[0];
  for (const [bx, by] of points.length > 1 ? points.slice(1) : points) {
    const [lowU, highU] = [Math.min(ax, bx) - radius, Math.max(ax, bx) + radius];
    const [lowV, highV] = [Math.min(ay, by) - radius, Math.max(ay, by) + radius];
    const [dx, dy] = [bx - ax, by - ay];
    const length2 = dx * dx + dy * dy;
    cells.touched(lowU, highU, lowV, highV, 0, (k) => {
      if (inside[at[k]]) return;
      const [p, q] = [u[k], v[k]];
      if (!(p >= lowU && p <= highU && q >= lowV && q <= highV)) return;
      const [wx, wy, ex, ey] = [p - ax, q - ay, p - bx, q - by];
      const along = wx * dx + wy * dy;
      if (along <= 0) inside[at[k]] = wx * wx + wy * wy <= square;
      else if (along >= length2) inside[at[k]] = ex * ex + ey * ey <= square;
      else {
        const aside = wx * dy - wy * dx;
        inside[at[k]] = aside * aside <= square * length2;
      }
    });
    [ax, ay] = [bx, by];
  }
  return inside;
}

// Calls test(k, i) for every splat; k is the index of its first coordinate.
function everyMember({ count }, test) {
  const inside = new Uint8Array(count);
  for (let i = 0, k = 0; i < count; ++i, k += 3) if (test(k, i)) inside[i] = 1;
  return inside;
}

// |axis . (mean - centre)| <= half extent along each axis.
export function boxMembers({ center, rotation, half }, values) {
  const { means } = values;
  const [cx, cy, cz] = center;
  const axes = [0, 1, 2].map((i) => rotation.map((row) => row[i]));
  return everyMember(values, (k) => {
    const [a, b, c] = [means[k] - cx, means[k + 1] - cy, means[k + 2] - cz];
    for (let i = 0; i < 3; ++i) {
      const axis = axes[i];
      const along = axis[0] * a + axis[1] * b + axis[2] * c;
      if (!(along >= -half[i] && along <= half[i])) return false;
    }
    return true;
  });
}

const isBetween = (value, low, high) =>
  !Number.isNaN(value) && (low === undefined || value >= low) && (high === undefined || value <= high);

// Returns 1 for every splat of the region that a "select" describes. values: {count, means, log_scales, logits, sh0}.
// work: counts one test for each splat, and those of the edges of a lasso and the segments of a stroke.
export function members(region, values, work = new EditWork()) {
  work.add(values.count);
  const { means, log_scales, logits, sh0 } = values;
  const { low, high } = region;
  switch (region.by) {
    case "rectangle": {
      const [u0, v0, u1, v1] = region.corners;
      const inside = new Uint8Array(values.count);
      for (const i of seenWithin(region, values, [u0, u1], [v0, v1]).at) inside[i] = 1;
      return inFront(region, values, inside, work);
    }
    case "lasso":
      return inFront(region, values, lassoMembers(region, values, work), work);
    case "brush":
      return inFront(region, values, brushMembers(region, values, work), work);
    case "sphere": {
      const [cx, cy, cz] = region.center;
      const square = region.radius * region.radius;
      return everyMember(values, (k) => {
        const [x, y, z] = [means[k] - cx, means[k + 1] - cy, means[k + 2] - cz];
        return x * x + y * y + z * z <= square;
      });
    }
    case "box":
      return boxMembers(region, values);
    case "color":
      return everyMember(values, (k) => [0, 1, 2].every((j) => isBetween(sh0[k + j], low[j], high[j])));
    case "opacity":
      return everyMember(values, (_k, i) => isBetween(logits[i], low, high));
    case "size":
      return everyMember(values, (k) =>
        isBetween(Math.max(Math.max(log_scales[k], log_scales[k + 1]), log_scales[k + 2]), low, high),
      );
    case "distance": {
      const [cx, cy, cz] = region.center;
      const [least, most] = [low, high].map((end) => (end === undefined ? undefined : end * end));
      return everyMember(values, (k) => {
        const [x, y, z] = [means[k] - cx, means[k + 1] - cy, means[k + 2] - cz];
        return isBetween(x * x + y * y + z * z, least, most);
      });
    }
    case "list":
      return listMembers(region, values);
    case "all":
      return everyMember(values, () => true);
  }
  throw new Error(`Unknown kind of selection: ${region.by}; reload the page.`);
}

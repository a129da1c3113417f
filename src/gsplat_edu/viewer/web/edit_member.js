// Which splats a region holds: exactly the same ones as in gsplat_edu/edits/membership.py.
//
// Both sides compute with the float32 parameters as float64 numbers, by +, -, *, / and comparisons only, in the order
// written here, so both find the same splats to the last one. NaN belongs to no region.
"use strict";

const EDIT_NEAR = 0.05; // world units: splats at this camera depth or closer are not seen in a picture

// Calls test(u, v, i) for every splat in front of a picture's camera, and returns the splats for which it is true:
// u = (fx x) / z + cx, v = (fy y) / z + cy.
function seenMembers({ camera }, { count, means }, test) {
  const inside = new Uint8Array(count);
  const [ex, ey, ez] = camera.position;
  const [[r00, r01, r02], [r10, r11, r12], [r20, r21, r22]] = camera.rotation; // camera to world: columns are the axes
  const { fx, fy, cx, cy } = camera;
  for (let i = 0, k = 0; i < count; ++i, k += 3) {
    const [a, b, c] = [means[k] - ex, means[k + 1] - ey, means[k + 2] - ez];
    const z = r02 * a + r12 * b + r22 * c;
    if (!(z > EDIT_NEAR)) continue;
    const x = r00 * a + r10 * b + r20 * c;
    const y = r01 * a + r11 * b + r21 * c;
    if (test((fx * x) / z + cx, (fy * y) / z + cy)) inside[i] = 1;
  }
  return inside;
}

// Even-odd rule within the polygon's bounds: counts the edges that cross the ray towards larger u.
function inPolygon(points) {
  const [us, vs] = [0, 1].map((axis) => Float64Array.from(points, (point) => point[axis]));
  const [lowU, highU] = extent(us);
  const [lowV, highV] = extent(vs);
  const count = points.length;
  return (u, v) => {
    if (!(u >= lowU && u <= highU && v >= lowV && v <= highV)) return false;
    let odd = false;
    for (let j = 0, i = count - 1; j < count; i = j++) {
      const ay = vs[i];
      const by = vs[j];
      if (ay > v !== by > v && u < ((us[j] - us[i]) * (v - ay)) / (by - ay) + us[i]) odd = !odd;
    }
    return odd;
  };
}

// Within the radius of a segment, and of the segment's bounds widened by the radius.
function onStroke(points, radius) {
  const square = radius * radius;
  const segments = (points.length > 1 ? points.slice(1) : points).map(([bx, by], i) => {
    const [ax, ay] = points[i];
    return { ax, ay, bx, by, dx: bx - ax, dy: by - ay };
  });
  const bounds = segments.map(({ ax, ay, bx, by }) => [
    Math.min(ax, bx) - radius,
    Math.max(ax, bx) + radius,
    Math.min(ay, by) - radius,
    Math.max(ay, by) + radius,
  ]);
  return (u, v) => {
    for (let i = 0; i < segments.length; ++i) {
      const [lowU, highU, lowV, highV] = bounds[i];
      if (!(u >= lowU && u <= highU && v >= lowV && v <= highV)) continue;
      const { ax, ay, bx, by, dx, dy } = segments[i];
      const [wx, wy, ex, ey] = [u - ax, v - ay, u - bx, v - by];
      const along = wx * dx + wy * dy;
      const length2 = dx * dx + dy * dy;
      if (along <= 0) {
        if (wx * wx + wy * wy <= square) return true;
      } else if (along >= length2) {
        if (ex * ex + ey * ey <= square) return true;
      } else {
        const aside = wx * dy - wy * dx;
        if (aside * aside <= square * length2) return true;
      }
    }
    return false;
  };
}

function extent(numbers) {
  return numbers.reduce(([low, high], x) => [Math.min(low, x), Math.max(high, x)], [Infinity, -Infinity]);
}

// Calls test(k, i) for every splat; k is the index of its first coordinate.
function everyMember({ count }, test) {
  const inside = new Uint8Array(count);
  for (let i = 0, k = 0; i < count; ++i, k += 3) if (test(k, i)) inside[i] = 1;
  return inside;
}

// |axis . (mean - centre)| <= half extent along each axis.
function boxMembers({ center, rotation, half }, values) {
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
  value === value && (low === undefined || value >= low) && (high === undefined || value <= high);

// Returns 1 for every splat of the region that a "select" describes. values: {count, means, log_scales, logits, sh0}.
function members(region, values) {
  const { means, log_scales, logits, sh0 } = values;
  const { low, high } = region;
  switch (region.by) {
    case "rectangle": {
      const [u0, v0, u1, v1] = region.corners;
      return seenMembers(region, values, (u, v) => u >= u0 && u <= u1 && v >= v0 && v <= v1);
    }
    case "lasso":
      return seenMembers(region, values, inPolygon(region.points));
    case "brush":
      return seenMembers(region, values, onStroke(region.points, region.radius));
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
      return everyMember(values, (k, i) => isBetween(logits[i], low, high));
    case "size":
      return everyMember(values, (k) =>
        isBetween(Math.max(Math.max(log_scales[k], log_scales[k + 1]), log_scales[k + 2]), low, high),
      );
    case "all":
      return everyMember(values, () => true);
  }
  throw new Error(`Unknown kind of selection: ${region.by}; reload the page.`);
}

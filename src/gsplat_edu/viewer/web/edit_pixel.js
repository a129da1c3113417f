// What is at one pixel, found by the processor: a click need not wait until the pictures before it are drawn.

import { ratioBounds } from "./camera.js";
import { SOLID } from "./draw.js";
import { SELECTED } from "./edit_flags.js";
import { turnSince } from "./edit_move.js";
import { product3 } from "./edit_rotations.js";
import { length3, rotated } from "./edit_shapes.js";
import { cross, dot, plus } from "./vectors.js";

const DEVIATIONS = 3.4; // beyond these, a splat of any opacity is below 1/255

// A constant of the shaders.
function shaderConstant(name) {
  const text = document.getElementById("splat.vert").textContent;
  return Number(text.match(new RegExp(`const float ${name} = ([^;]+);`))[1]);
}

// The splats that may cover a part of the picture, near to far, as {i, depth, u, v, reach}: those whose reach from their
// centre, which is overestimated, touches it.
export function splatsWithin({ count, means, log_scales }, flags, camera, [u0, v0, u1, v1], near) {
  const found = [];
  const { R, eye, fx, fy, cx, cy } = camera;
  const focal = Math.max(fx, fy);
  for (let i = 0, k = 0; i < count; ++i, k += 3) {
    if (flags[i] > SELECTED) continue;
    const [a, b, c] = [means[k] - eye[0], means[k + 1] - eye[1], means[k + 2] - eye[2]];
    const depth = R[2][0] * a + R[2][1] * b + R[2][2] * c;
    if (!(depth > near)) continue;
    const x = (R[0][0] * a + R[0][1] * b + R[0][2] * c) / depth;
    const y = (R[1][0] * a + R[1][1] * b + R[1][2] * c) / depth;
    const size = Math.exp(Math.max(log_scales[k], log_scales[k + 1], log_scales[k + 2]));
    const reach = DEVIATIONS * (1 + (focal / depth) * size * (1 + Math.abs(x) + Math.abs(y)));
    const [u, v] = [fx * x + cx, fy * y + cy];
    if (u0 - u <= reach && u - u1 <= reach && v0 - v <= reach && v - v1 <= reach) found.push({ i, depth, u, v, reach });
  }
  return found.sort((a, b) => a.depth - b.depth || a.i - b.i);
}

// The splats that may cover a pixel, far to near.
export function splatsAt(values, flags, camera, column, row, near) {
  const found = splatsWithin(values, flags, camera, [column, row, column, row], near);
  return Uint32Array.from(found.reverse(), ({ i }) => i);
}

// What a splat covers, as in splat.vert.glsl: centre, half extents and inverse covariance in the picture, opacity, camera
// depth, and its standard deviation in depth; null if it is not drawn. bounds: of x/z and y/z in the Jacobian.
export function footprintOf(values, i, camera, bounds, antialiased) {
  const { means, log_scales, quats, logits } = values;
  footprintOf.constants ??= ["DILATION", "ALPHA_MIN", "DET_FLOOR"].map(shaderConstant);
  const [DILATION, LEAST, FLOOR] = footprintOf.constants;
  const { R, eye, fx, fy, cx, cy } = camera;
  const [x, y, z] = rotated(
    R,
    [0, 1, 2].map((j) => means[3 * i + j] - eye[j]),
  );
  if (Math.abs(x) > bounds.widest[0] * z || Math.abs(y) > bounds.widest[1] * z) return null;
  const q = [0, 1, 2, 3].map((j) => quats[4 * i + j]);
  const norm = Math.hypot(...q);
  if (!norm) return null;
  const turn = product3(turnSince(values, i), matrixOf(q.map((value) => value / norm)));
  const scales = [0, 1, 2].map((j) => Math.exp(log_scales[3 * i + j]));
  const along = (axis) =>
    scales.map((scale, k) => scale * (axis[0] * turn[0][k] + axis[1] * turn[1][k] + axis[2] * turn[2][k]));
  const ratio = [x / z, y / z].map((value, j) => Math.min(Math.max(value, bounds.low[j]), bounds.high[j]));
  // rows of J W R S
  const [row0, row1] = [fx, fy].map((focal, j) =>
    along(plus(R[j], R[2], -ratio[j]).map((value) => (value * focal) / z)),
  );
  const [a0, b, c0] = [dot(row0, row0), dot(row0, row1), dot(row1, row1)];
  const normal = cross(row0, row1);
  const det0 = dot(normal, normal);
  const [a, c] = [a0 + DILATION, c0 + DILATION];
  const det = det0 + DILATION * (a0 + c0) + DILATION * DILATION;
  const opacity = (antialiased ? Math.sqrt(Math.max(det0, FLOOR) / det) : 1) / (1 + Math.exp(-logits[i]));
  const level = 2 * Math.log(opacity / LEAST);
  if (!(level >= 0)) return null;
  return {
    i,
    u: (fx * x) / z + cx,
    v: (fy * y) / z + cy,
    halfU: Math.sqrt(level * a),
    halfV: Math.sqrt(level * c),
    conicA: c / det,
    conicB: -b / det,
    conicC: a / det,
    opacity,
    level,
    depth: z,
    deviation: length3(along(R[2])),
  };
}

// Alpha of a footprint at a place of the picture, as in splat.frag.glsl.
export function alphaAt({ u, v, conicA, conicB, conicC, opacity, level }, column, row) {
  alphaAt.constants ??= ["ALPHA_MIN", "ALPHA_MAX"].map(shaderConstant);
  const dx = column - u;
  const dy = row - v;
  const power = -0.5 * (conicA * dx * dx + conicC * dy * dy) - conicB * dx * dy;
  if (!(-2 * power <= level + 1e-6)) return 0; // surely below the smallest alpha: most places, without an exponential
  const alpha = Math.min(alphaAt.constants[1], opacity * Math.exp(power));
  return alpha >= alphaAt.constants[0] ? alpha : 0;
}

// Rows of the rotation matrix of a unit quaternion (w, x, y, z).
function matrixOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

// Camera depth of the visible surface at a pixel, as Renderer.surface finds it by drawing: where half of the pixel's
// opacity is reached; null if there is little.
export function depthAtPixel(values, flags, camera, settings, column, row, near) {
  const bounds = ratioBounds(camera, settings);
  const reached = []; // opacity up to each splat, near to far
  let clear = 1;
  for (const { i } of splatsWithin(values, flags, camera, [column, row, column, row], near)) {
    const print = footprintOf(values, i, camera, bounds, settings.antialiased);
    const alpha = print ? alphaAt(print, column, row) : 0;
    clear *= 1 - alpha;
    if (alpha) reached.push({ depth: print.depth, opacity: 1 - clear });
  }
  const half = 0.5 * (1 - clear);
  if (!(half >= SOLID)) return null;
  return reached.find(({ opacity }) => opacity >= half).depth;
}

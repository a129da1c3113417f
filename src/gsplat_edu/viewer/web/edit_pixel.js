// What is at one pixel, found by the processor: a click need not wait until the pictures before it are drawn.
"use strict";

const DEVIATIONS = 3.4; // beyond these, a splat of any opacity is below 1/255

// A constant of the shaders.
function shaderConstant(name) {
  const text = document.getElementById("splat.vert").textContent;
  return Number(text.match(new RegExp(`const float ${name} = ([^;]+);`))[1]);
}

// The splats that may cover a pixel, far to near: those whose extent, which is overestimated, reaches it.
function splatsAt({ count, means, log_scales }, flags, camera, column, row, near) {
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
    if (Math.abs(fx * x + cx - column) <= reach && Math.abs(fy * y + cy - row) <= reach) found.push({ i, depth });
  }
  return Uint32Array.from(found.sort((a, b) => b.depth - a.depth || b.i - a.i), ({ i }) => i);
}

// Alpha of a splat at a pixel, as in splat.vert.glsl and splat.frag.glsl. bounds: of x/z and y/z in the Jacobian.
function alphaAt({ means, log_scales, quats, logits }, i, camera, bounds, antialiased, column, row) {
  const [DILATION, LEAST, MOST, FLOOR] = alphaAt.constants;
  const { R, eye, fx, fy, cx, cy } = camera;
  const [x, y, z] = rotated(R, [0, 1, 2].map((j) => means[3 * i + j] - eye[j]));
  const q = [0, 1, 2, 3].map((j) => quats[4 * i + j]);
  const norm = Math.hypot(...q);
  if (!norm) return 0;
  const turn = rotationOf(q.map((value) => value / norm));
  const scales = [0, 1, 2].map((j) => Math.exp(log_scales[3 * i + j]));
  const ratio = [x / z, y / z].map((value, j) => Math.min(Math.max(value, bounds.low[j]), bounds.high[j]));
  // rows of J W R S
  const [row0, row1] = [fx, fy].map((focal, j) => {
    const axis = plus(R[j], R[2], -ratio[j]).map((value) => (value * focal) / z);
    return [0, 1, 2].map((k) => scales[k] * (axis[0] * turn[0][k] + axis[1] * turn[1][k] + axis[2] * turn[2][k]));
  });
  const [a0, b, c0] = [dot(row0, row0), dot(row0, row1), dot(row1, row1)];
  const normal = cross(row0, row1);
  const det0 = dot(normal, normal);
  const det = det0 + DILATION * (a0 + c0) + DILATION * DILATION;
  const opacity = (antialiased ? Math.sqrt(Math.max(det0, FLOOR) / det) : 1) / (1 + Math.exp(-logits[i]));
  const [dx, dy] = [column - (fx * x) / z - cx, row - (fy * y) / z - cy];
  const power = (-0.5 * ((c0 + DILATION) * dx * dx + (a0 + DILATION) * dy * dy) + b * dx * dy) / det;
  const alpha = Math.min(MOST, opacity * Math.exp(power));
  return alpha >= LEAST ? alpha : 0;
}

// Rows of the rotation matrix of a unit quaternion (w, x, y, z).
function rotationOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

// Camera depth of the visible surface at a pixel, as Renderer.surface finds it by drawing: where half of the pixel's
// opacity is reached; null if there is little.
function depthAtPixel(values, flags, camera, settings, column, row, near) {
  alphaAt.constants ??= ["DILATION", "ALPHA_MIN", "ALPHA_MAX", "DET_FLOOR"].map(shaderConstant);
  const bounds = ratioBounds(camera, settings.jacobian_limit);
  const reached = []; // opacity up to each splat, near to far
  let clear = 1;
  for (const i of splatsAt(values, flags, camera, column, row, near).reverse()) {
    const alpha = alphaAt(values, i, camera, bounds, settings.antialiased, column, row);
    clear *= 1 - alpha;
    if (alpha) reached.push({ i, opacity: 1 - clear });
  }
  const half = 0.5 * (1 - clear);
  if (!(half >= SOLID)) return null;
  const { i } = reached.find(({ opacity }) => opacity >= half);
  return dot(camera.R[2], [0, 1, 2].map((j) => values.means[3 * i + j] - camera.eye[j]));
}

// Cameras: {R, eye, fx, fy, cx, cy, W, H} as in gsplat_edu/camera.py, R from world to camera with rows (right, down,
// forward).
"use strict";

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);

// Turns a vector about an axis of length 1, by the right hand: Rodrigues' formula.
function turned(vector, axis, angle) {
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  const around = cross(axis, vector);
  const along = dot(axis, vector) * (1 - cos);
  return vector.map((value, i) => value * cos + around[i] * sin + axis[i] * along);
}

// What a camera shows, in a window of another shape: its whole image, as large as fits, in the middle.
function fitted(camera, width, height) {
  const scale = Math.min(width / camera.W, height / camera.H);
  const moved = (middle, from, to) => (middle + 0.5) * scale - 0.5 + 0.5 * (to - from * scale);
  return {
    ...camera,
    fx: camera.fx * scale,
    fy: camera.fy * scale,
    cx: moved(camera.cx, camera.W, width),
    cy: moved(camera.cy, camera.H, height),
    W: width,
    H: height,
  };
}

// Bounds of x/z and y/z in the Jacobian, as Camera.jacobian_bounds has them; without a limit, all a float holds.
function ratioBounds(camera, limit) {
  if (limit === null) return { low: [-3e38, -3e38], high: [3e38, 3e38] };
  const bounds = (side) => [
    (0.5 * (camera.W - 1) + side * 0.5 * limit * camera.W - camera.cx) / camera.fx,
    (0.5 * (camera.H - 1) + side * 0.5 * limit * camera.H - camera.cy) / camera.fy,
  ];
  return { low: bounds(-1), high: bounds(1) };
}

// Where the visitor stands and looks, and the point ahead that orbits go around.
class View {
  constructor({ camera, pivot, up }) {
    this.start = camera;
    this.pivot = pivot;
    this.up = up;
    this.goTo(camera);
    this.pace = this.distance; // flying covers it in two seconds
  }

  goTo(camera) {
    this.camera = camera;
    const towards = plus(this.pivot, camera.eye, -1);
    const ahead = dot(camera.R[2], towards);
    this.distance = ahead > 0 ? ahead : Math.hypot(...towards) || 1;
  }

  reset() {
    this.goTo(this.start);
  }

  centre() {
    return plus(this.camera.eye, this.camera.R[2], this.distance);
  }

  // Turns the head by angles to the right and downwards; not over the zenith, where left and right change places.
  look(right, down) {
    const level = this.camera.R.map((row) => turned(row, this.up, -right));
    const R = level.map((row) => turned(row, level[0], -down));
    const steepness = (rows) => Math.abs(dot(rows[2], this.up));
    const allowed = steepness(R) < 0.999 || steepness(R) < steepness(level);
    this.camera = { ...this.camera, R: allowed ? R : level };
  }

  // Turns about the point ahead.
  orbit(right, down) {
    const centre = this.centre();
    this.look(right, down);
    this.camera = { ...this.camera, eye: plus(centre, this.camera.R[2], -this.distance) };
  }

  // Moves by world units along the camera's axes (right, down, forward).
  move(steps) {
    const eye = steps.reduce((at, step, i) => plus(at, this.camera.R[i], step), this.camera.eye);
    this.camera = { ...this.camera, eye };
  }

  // Moves with the picture: a drag by so many pixels of a window whose camera is `shown`.
  pan(dx, dy, shown) {
    this.move([(-dx * this.distance) / shown.fx, (-dy * this.distance) / shown.fy, 0]);
  }

  // Goes nearer (factor below 1) or farther; the point ahead stays.
  zoom(factor) {
    const distance = Math.min(Math.max(this.distance * factor, 1e-3 * this.pace), 1e3 * this.pace);
    this.move([0, 0, this.distance - distance]);
    this.distance = distance;
  }
}

// Cameras: {R, eye, fx, fy, cx, cy, W, H} as in gsplat_edu/scene/camera.py, R from world to camera with rows (right, down,
// forward).

import { Region } from "./region.js";
import { dot, plus, turned } from "./vectors.js";

const ORBIT_STEP = Math.PI / 180;
const NEAREST = 0.01; // distance to the pivot, in initial distances
const FARTHEST = 3; // the same, and of the pivot from the initial one, in distances of the farthest camera

const AMONG = 1.1; // distance from the subject up to which the eye is among the photos' cameras, in that of the farthest
const YIELD = 0.1; // beyond it, a move outward shrinks by a factor of e per this distance

// Most that a wide window enlarges the image beyond fitting it: at most a fifth of its height is cropped.
const MOST_CROPPED = 1.25;

// Most that a narrow window shows above and below the image, in the image's height: at most a third of the window is what
// other photos show. More would be mostly what no photo shows.
const MOST_BEYOND = 1.5;

// Width of a narrow window and height of a wide one, in those of the subject that has to be in view.
const ROOM = 1.1;

// Least part of a window's height below the panel; in a lower window, the panel lies over the picture.
const LEAST_FREE = 0.2;

// Fits a camera to a window of another shape, of which a panel covers `covered` px at the top. A narrow window shows the
// whole width if it then shows at most `MOST_BEYOND` times the height; otherwise the sides are cropped, but as much as
// `subject` (left, top, right, bottom in px of the image) stays in view. A wide window shows some more at the sides and
// crops a little of the height, but not the subject. The centre of the image, or of the subject, is in the middle of the
// part without a panel.
export function fitted(camera, width, height, covered = 0) {
  const { subject, ...rest } = camera;
  const free = height - covered < LEAST_FREE * height ? height : height - covered;
  const [across, down] = [width / camera.W, free / camera.H];
  let scale = across > down ? Math.min(across, MOST_CROPPED * down) : Math.max(across, down / MOST_BEYOND);
  let [x, y] = [0.5 * camera.W, 0.5 * camera.H];
  if (subject) {
    const [left, top, right, bottom] = subject;
    if (across < down) {
      scale = Math.min(scale, Math.max(across, width / (ROOM * (right - left))));
      x = within(0.5 * (left + right), camera.W, width / scale);
    } else scale = Math.min(scale, Math.max(down, free / (ROOM * (bottom - top))));
    y = within(0.5 * (top + bottom), camera.H, free / scale);
  }
  const moved = (middle, from, to) => (middle + 0.5 - from) * scale - 0.5 + 0.5 * to;
  return {
    ...rest,
    fx: camera.fx * scale,
    fy: camera.fy * scale,
    cx: moved(camera.cx, x, width),
    cy: moved(camera.cy, y, free) + height - free,
    W: width,
    H: height,
  };
}

// The middle of a window on one axis of an image, moved so that neither of the two extends beyond the other on one side
// only.
function within(middle, image, shown) {
  const [a, b] = [0.5 * shown, image - 0.5 * shown];
  return Math.min(Math.max(middle, Math.min(a, b)), Math.max(a, b));
}

// The point at a given depth that a camera sees at column u and row v.
export function pointAt(camera, u, v, depth) {
  const ray = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1];
  return ray.reduce((at, step, i) => plus(at, camera.R[i], step * depth), camera.eye);
}

// Bounds of x/z and y/z in the Jacobian, as in Camera.jacobian_bounds; without a limit, the largest float.
export function ratioBounds(camera, { jacobian_limit: limit, beyond }) {
  const edges = [
    Math.max(0.5 + camera.cx, camera.W - 0.5 - camera.cx) / camera.fx,
    Math.max(0.5 + camera.cy, camera.H - 0.5 - camera.cy) / camera.fy,
  ];
  const widest = edges.map((edge) => (beyond ? Math.max(beyond[0] * edge, beyond[1]) : 3e38));
  if (limit === null) return { low: [-3e38, -3e38], high: [3e38, 3e38], widest };
  const bounds = (side) => [
    (0.5 * (camera.W - 1) + side * 0.5 * limit * camera.W - camera.cx) / camera.fx,
    (0.5 * (camera.H - 1) + side * 0.5 * limit * camera.H - camera.cy) / camera.fy,
  ];
  return { low: bounds(-1), high: bounds(1), widest };
}

// The user's viewpoint and the pivot of orbits.
export class View {
  // start: camera, pivot and up of the initial view. eyes: centres of the capture's cameras.
  constructor({ camera, pivot, up }, eyes) {
    this.start = camera;
    this.pivot = pivot;
    this.up = up;
    this.region = new Region(eyes);
    this.bounds = "directions"; // what slows a move: directions that no photo shows, "photos": distance too, or "none"
    this.goTo(camera);
    this.pace = this.distance; // flying covers this distance in two seconds
    this.reach = Math.max(this.pace, ...eyes.map((eye) => Math.hypot(...plus(eye, pivot, -1))));
    this.region.around(this.focus);
    this.turn = this.region.turn();
  }

  goTo(camera) {
    this.camera = camera;
    const towards = plus(this.pivot, camera.eye, -1);
    const ahead = dot(camera.R[2], towards);
    this.focus = plus(camera.eye, camera.R[2], ahead > 0 ? ahead : Math.hypot(...towards) || 1);
    this.allowed = null;
  }

  reset() {
    this.goTo(this.start);
  }

  centre() {
    return this.focus;
  }

  get distance() {
    return Math.hypot(...plus(this.focus, this.camera.eye, -1));
  }

  // Sets another pivot; the picture stays the same.
  orbitAround(point) {
    this.focus = point;
    this.allowed = null;
  }

  // The camera's axes after turning to the right and down by given angles; never across the zenith, where left and
  // right would swap.
  turnedHead(right, down) {
    const level = this.camera.R.map((row) => turned(row, this.up, -right));
    const R = level.map((row) => turned(row, level[0], -down));
    const steepness = (rows) => Math.abs(dot(rows[2], this.up));
    return steepness(R) < 0.999 || steepness(R) < steepness(level) ? R : level;
  }

  // Turns the camera in place.
  look(right, down) {
    const { distance } = this;
    this.camera = { ...this.camera, R: this.turnedHead(right, down) };
    this.orbitAround(plus(this.camera.eye, this.camera.R[2], distance));
  }

  // Orbits in steps so small that a fast drag is damped as much as a slow one.
  orbit(right, down) {
    if (this.allowed === null) {
      this.region.around(this.focus);
      // the limit does not apply once the user has flown or panned outside
      this.allowed = Math.max(this.region.margin, this.region.distance(plus(this.camera.eye, this.focus, -1)));
    }
    const steps = Math.max(1, Math.ceil(Math.hypot(right, down) / ORBIT_STEP));
    for (let i = 0; i < steps; ++i) this.orbitStep(right / steps, down / steps);
  }

  orbitStep(right, down) {
    const offset = plus(this.camera.eye, this.focus, -1);
    const before = this.region.distance(offset);
    let [R, around] = this.orbited(offset, right, down);
    if (this.bounds !== "none" && this.region.distance(around) > before) {
      const share = this.region.share(before, this.allowed);
      [R, around] = this.orbited(offset, share * right, share * down);
    }
    this.camera = { ...this.camera, R, eye: plus(this.focus, around) };
  }

  // Axes, and the eye relative to the pivot, rotated with the axes.
  orbited(offset, right, down) {
    const R = this.turnedHead(right, down);
    const seen = this.camera.R.map((row) => dot(row, offset));
    return [R, [0, 1, 2].map((i) => R[0][i] * seen[0] + R[1][i] * seen[1] + R[2][i] * seen[2])];
  }

  // Fraction of a move of the eye that is applied: all of it among the photos' cameras, and towards them.
  share(next, eye = this.camera.eye) {
    const away = (point) => Math.hypot(...plus(point, this.pivot, -1)) / this.reach;
    const now = away(eye);
    return this.bounds === "photos" && away(next) > now ? Math.exp(-Math.max(0, now - AMONG) / YIELD) : 1;
  }

  // Moves by world units along the camera's axes (right, down, forward), but not so far away that the scene is lost.
  move(steps) {
    const before = this.focus;
    const asked = steps.reduce((at, step, i) => plus(at, this.camera.R[i], step), [0, 0, 0]);
    let after = plus(before, asked, this.share(plus(this.camera.eye, asked)));
    const away = (point) => Math.hypot(...plus(point, this.pivot, -1));
    const most = Math.max(FARTHEST * this.reach, away(before));
    if (away(after) > most) after = plus(this.pivot, plus(after, this.pivot, -1), most / away(after));
    this.camera = { ...this.camera, eye: plus(this.camera.eye, plus(after, before, -1)) };
    this.orbitAround(after);
  }

  // Pans with the picture: dx, dy in pixels of a window whose camera is `shown`.
  pan(dx, dy, shown) {
    const depth = Math.abs(dot(this.camera.R[2], plus(this.focus, this.camera.eye, -1)));
    this.move([(-dx * depth) / shown.fx, (-dy * depth) / shown.fy, 0]);
  }

  // Moves closer to the pivot (factor below 1) or farther away.
  zoom(factor) {
    const most = Math.max(FARTHEST * this.reach, this.distance);
    const offset = plus(this.camera.eye, this.focus, -1);
    const share = this.share(plus(this.focus, offset, factor));
    const distance = Math.min(Math.max(this.distance * (1 + share * (factor - 1)), NEAREST * this.pace), most);
    this.camera = { ...this.camera, eye: plus(this.focus, offset, distance / this.distance) };
  }
}

// Where a visitor with a headset stands in the scene. A headset's space has metres, x to the right, y up, and z backward.
//
// A stand {axes, origin, metre} maps it to the scene, p -> origin + metre (p0 axes[0] + p1 axes[1] + p2 axes[2]): axes are
// directions of the scene, and metre is one in the scene's units. Matrices are WebXR's: 4 x 4, by columns.

import { cross, dot, plus, radians, turned, unit } from "./vectors.js";

const IN_METRES = { m: 1, cm: 100, mm: 1000 }; // units of a scene in a metre
const AWAY = 2; // metres to the subject of a scene of unknown size
const STEEP = 0.1; // least level part of a direction of length 1 that still tells where it heads

const UP = [0, 1, 0];
const SNAP = radians(30); // of one turn
const PUSHED = 0.7; // how far a stick is pushed for a turn or a step; for the next one, it has to come back to:
const RELEASED = 0.4;
const SLACK = 0.15; // of a stick at rest
const SPEED = 1; // metres per second
const STRIDE = 0.5; // metres, of a step

// How many units of the scene a metre has. In a scene of known unit everything has its true size. In another one, the
// subject is as far away as a person stands from what they look at, so `distance` in the scene counts as AWAY metres.
export function metreOf(unitName, distance) {
  return IN_METRES[unitName] ?? distance / AWAY;
}

const column = (matrix, i) => [...matrix.slice(4 * i, 4 * i + 3)];

// The level direction, of length 1, in which somebody looks: ahead, or along their forehead if they look up or down.
export function heading(ahead, above, up) {
  const level = (a) => plus(a, up, -dot(a, up));
  const flat = level(ahead);
  if (Math.hypot(...flat) >= STEEP) return unit(flat);
  const down = dot(ahead, up) < 0;
  return unit(level(above).map((value) => (down ? value : -value)));
}

// Place and heading of a head with this pose.
export function headOf(matrix) {
  const ahead = column(matrix, 2).map((value) => -value);
  return { at: column(matrix, 3), heading: heading(ahead, column(matrix, 1), UP) };
}

// A direction in the headset's space as one of the scene.
export function along({ axes }, direction) {
  return axes.reduce((sum, axis, i) => plus(sum, axis, direction[i]), [0, 0, 0]);
}

// A point of the headset's space in the scene.
export function placed(stand, point) {
  return plus(stand.origin, along(stand, point), stand.metre);
}

// The stand in which the head is where a camera is and heads where it does. The ground is level, however the camera tilts.
export function standAt({ R, eye }, up, head, metre) {
  const ahead = heading(
    R[2],
    R[1].map((value) => -value),
    up,
  );
  const [right, before] = [cross(ahead, up), cross(head.heading, UP)];
  const axes = [0, 1, 2].map((i) =>
    [0, 1, 2].map((j) => before[i] * right[j] + UP[i] * up[j] + head.heading[i] * ahead[j]),
  );
  return moveTo({ axes, metre }, head, eye);
}

// The same with the head at a point of the scene.
function moveTo(stand, head, eye) {
  return { ...stand, origin: plus(eye, along(stand, head.at), -stand.metre) };
}

// The stand after so many snap turns to the right about the head.
export function turnedStand(stand, head, turns) {
  const axes = stand.axes.map((axis) => turned(axis, stand.axes[1], -turns * SNAP));
  return moveTo({ ...stand, axes }, head, placed(stand, head.at));
}

// The page's camera of an eye with this pose, projection and size of its picture.
export function eyeCamera(stand, pose, projection, { width: W, height: H }) {
  const axis = (i, sign) => along(stand, column(pose, i)).map((value) => sign * value);
  return {
    R: [axis(0, 1), axis(1, -1), axis(2, -1)],
    eye: placed(stand, column(pose, 3)),
    fx: 0.5 * W * projection[0],
    fy: 0.5 * H * projection[5],
    cx: 0.5 * W * (1 - projection[8]) - 0.5,
    cy: 0.5 * H * (1 + projection[9]) - 0.5,
    W,
    H,
  };
}

// How the sticks are pushed, (right, back): the left one moves, every other one turns.
export function pushes(sources) {
  const pushed = { turn: 0, move: [0, 0] };
  for (const { gamepad, handedness } of sources) {
    if (!gamepad || gamepad.axes.length < 2) continue;
    const stick = gamepad.axes.slice(-2); // behind those of a touchpad
    if (handedness === "left") pushed.move = stick;
    else pushed.turn = stick[0];
  }
  return pushed;
}

// Tells when a stick is pushed far, once for each push.
export class Push {
  constructor() {
    this.held = false;
  }

  begins(far) {
    const before = this.held;
    this.held = far > (before ? RELEASED : PUSHED);
    return this.held && !before;
  }
}

// The way in the scene that a push of the left stick moves the head: level, and ahead is where the head heads. It glides
// for some seconds, or makes a step.
export function wayOf(stand, head, [right, back], { seconds = 0, isStep = false }) {
  const far = Math.hypot(right, back);
  const length = isStep ? STRIDE : (SPEED * seconds * Math.max(0, far - SLACK)) / (1 - SLACK);
  const aside = cross(head.heading, UP);
  const way = [0, 1, 2].map((i) => ((right * aside[i] - back * head.heading[i]) / (far || 1)) * length);
  return along(stand, way).map((value) => value * stand.metre);
}

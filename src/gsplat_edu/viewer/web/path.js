// Smooth camera motion through keyframes: the formulas of gsplat_edu/paths/curve.py, which explains them.

import { plus, radians } from "./vectors.js";

const CHORDS = 64; // per segment; their sum approximates its length
const SAME = 1e-9; // fraction of the length below which consecutive keyframes count as one place
const SEGMENT_SECONDS = 2; // from one keyframe to the next, on average, without times and duration

const norm = (vector) => Math.hypot(...vector);

// The unit quaternion (w, x, y, z) of the rotation from camera to world, whose columns are the rows of R. The largest
// component comes from the diagonal, the others from sums and differences across it.
function quaternionOf(R) {
  const [[xx, yx, zx], [xy, yy, zy], [xz, yz, zz]] = R;
  const squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz];
  const rows = [
    [squares[0], zy - yz, xz - zx, yx - xy],
    [zy - yz, squares[1], yx + xy, xz + zx],
    [xz - zx, yx + xy, squares[2], zy + yz],
    [yx - xy, xz + zx, zy + yz, squares[3]],
  ];
  const row = rows[squares.indexOf(Math.max(...squares))];
  return row.map((value) => value / norm(row));
}

// The rotation from world to camera.
export function rotationOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

// The angle between unit quaternions in four dimensions, exact for equal ones: no arc cosine.
function quaternionAngle(a, b) {
  return 2 * Math.atan2(norm(plus(a, b, -1)), norm(plus(a, b)));
}

// Slerp, for shares outside 0 to 1 too; the signs of the quaternions stay as they are.
function slerp(a, b, share) {
  const angle = quaternionAngle(a, b);
  const sine = Math.sin(angle);
  let mixed;
  if (sine >= 1e-9) {
    const [of_a, of_b] = [Math.sin((1 - share) * angle) / sine, Math.sin(share * angle) / sine];
    mixed = a.map((value, i) => of_a * value + of_b * b[i]);
  } else if (angle < 1) mixed = a.map((value, i) => (1 - share) * value + share * b[i]);
  else mixed = share < 0.5 ? a : b; // opposite ones are one rotation
  return mixed.map((value) => value / norm(mixed));
}

// States have the centre, the quaternion, and zoom = ln tan(fov / 2).
export function mixedStates(a, b, share) {
  return {
    eye: a.eye.map((value, i) => (1 - share) * value + share * b.eye[i]),
    quat: slerp(a.quat, b.quat, share),
    zoom: (1 - share) * a.zoom + share * b.zoom,
  };
}

// Interpolates a non-decreasing table by cubics that do not decrease either and whose slope is continuous.
class Monotone {
  // ease: "ends" makes the slope zero at both ends, "views" in each row.
  constructor(x, y, loop, ease = null) {
    const h = x.slice(1).map((value, i) => value - x[i]);
    const secants = h.map((step, i) => (y[i + 1] - y[i]) / step);
    const last = h.length - 1;
    const mean = (i, j) => {
      if (secants[i] <= 0 || secants[j] <= 0) return 0;
      const [w0, w1] = [2 * h[j] + h[i], h[j] + 2 * h[i]];
      return (w0 + w1) / (w0 / secants[i] + w1 / secants[j]);
    };
    const inner = h.slice(1).map((_, i) => mean(i, i + 1));
    const ends = loop ? [mean(last, 0), mean(last, 0)] : [secants[0], secants[last]];
    const slopes = [ends[0], ...inner, ends[1]];
    const stops = (i) => ease === "views" || (ease === "ends" && (i === 0 || i === h.length));
    Object.assign(this, { x, y, h, slopes: slopes.map((slope, i) => (stops(i) ? 0 : slope)) });
  }

  at(value) {
    const { x, y, h, slopes } = this;
    const i = intervalOf(x, value);
    const s = (value - x[i]) / h[i];
    const [left, right, rise] = [h[i] * slopes[i], h[i] * slopes[i + 1], y[i + 1] - y[i]];
    return y[i] + s * (left + s * (3 * rise - 2 * left - right + s * (left + right - 2 * rise)));
  }
}

// The index of the interval of an increasing list that contains a value, by bisection.
function intervalOf(list, value) {
  let [low, high] = [0, list.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (list[middle] <= value) low = middle;
    else high = middle;
  }
  return low;
}

// Running sums, beginning with 0.
function sums(steps) {
  let sum = 0;
  return [0, ...steps.map((step) => (sum += step))];
}

export class PathCurve {
  // path: {loop, duration or null, ease: "ends", "views" or none, keyframes: [{eye, R, fov, time, hold}]}, at least two
  // keyframes; time and hold may be undefined.
  constructor({ loop, duration, ease, keyframes }) {
    const timed = keyframes[0].time !== undefined;
    const times = timed ? keyframes.map(({ time }) => time - keyframes[0].time) : [];
    const segments = keyframes.length - (loop ? 0 : 1);
    this.loop = loop;
    this.seconds = duration ?? (timed ? times.at(-1) + (keyframes.at(-1).hold ?? 0) : SEGMENT_SECONDS * segments);
    const states = statesOf(loop ? [...keyframes, keyframes[0]] : keyframes);
    this.chooseRadius(states);
    const steps = states.slice(1).map((state, i) => this.distance(states[i], state));
    const least = SAME * steps.reduce((sum, step) => sum + step, 0);
    this.nodes = states.filter((_, i) => i === 0 || steps[i - 1] > least);
    this.knots = sums(steps.filter((step) => step > least).map(Math.sqrt));
    this.measure();
    const nodeOf = sums(steps.map((step) => (step > least ? 1 : 0)));
    this.stops = keyframes.map((_, i) => this.lengths[CHORDS * nodeOf[i]]); // the distance at which each is met
    if (timed) this.places = this.timed(times, keyframes, ease);
    else if (ease && this.length > 0) {
      const lengths = this.lengths.filter((_, i) => i % CHORDS === 0);
      this.places = new Monotone(
        lengths.map((length) => this.seconds * (length / this.length)),
        lengths,
        loop,
        ease,
      );
    }
  }

  // The distance covered over time, with keyframes at given times; a rest has two rows.
  timed(times, keyframes, ease) {
    const rows = times.flatMap((time, i) =>
      [0, ...(keyframes[i].hold ? [keyframes[i].hold] : [])].map((after) => [time + after, this.stops[i]]),
    );
    if (this.loop) rows.push([this.seconds, this.length]);
    return new Monotone(
      rows.map(([time]) => time),
      rows.map(([, place]) => place),
      this.loop,
      ease,
    );
  }

  // World units per radian: L / max(A, 2 pi) on a path of length L that turns by A.
  chooseRadius(states) {
    this.radius = 0;
    let [length, turn] = [0, 0];
    for (let i = 1; i < states.length; ++i) {
      length += this.distance(states[i - 1], states[i]);
      turn += this.turn(states[i - 1], states[i]);
    }
    this.radius = length > 0 ? length / Math.max(turn, 2 * Math.PI) : 1;
  }

  turn(a, b) {
    const angle = 2 * quaternionAngle(a.quat, b.quat);
    return Math.hypot(Math.min(angle, 2 * Math.PI - angle), b.zoom - a.zoom);
  }

  distance(a, b) {
    return Math.hypot(norm(plus(b.eye, a.eye, -1)), this.radius * this.turn(a, b));
  }

  // Tabulates the length of the curve.
  measure() {
    [this.lengths, this.length] = [[0], 0];
    if (this.nodes.length === 1) return;
    const parameters = [];
    for (let i = 0; i + 1 < this.knots.length; ++i) {
      const span = this.knots[i + 1] - this.knots[i];
      for (let step = 0; step < CHORDS; ++step) parameters.push(this.knots[i] + (span * step) / CHORDS);
    }
    parameters.push(this.knots[this.knots.length - 1]);
    const states = parameters.map((u) => this.state(u));
    const chords = states.slice(1).map((state, i) => this.distance(states[i], state));
    const total = chords.reduce((sum, chord) => sum + chord, 0);
    for (const chord of chords) this.lengths.push((this.length += Math.max(chord, 1e-12 * total)));
    this.parameters = new Monotone(this.lengths, parameters, this.loop);
  }

  // The camera after a number of seconds: {eye, R, fov}. An open path ends, a loop repeats.
  pose(seconds) {
    const { loop, seconds: all } = this;
    const at = loop ? ((seconds % all) + all) % all : Math.min(Math.max(seconds, 0), all);
    const place = this.places ? this.places.at(at) : (this.length * at) / all;
    const { eye, quat, zoom } = this.state(this.nodes.length > 1 ? this.parameters.at(place) : 0);
    return { eye, R: rotationOf(quat), fov: (2 * Math.atan(Math.exp(zoom)) * 180) / Math.PI };
  }

  // The state at a parameter of the spline: the mixture of two parabolas, or of fewer at an open end.
  state(u) {
    const last = this.nodes.length - 1;
    if (last === 0) return this.nodes[0];
    const i = intervalOf(this.knots, u);
    const share = (u - this.knots[i]) / (this.knots[i + 1] - this.knots[i]);
    if (!this.loop && last === 1) return mixedStates(this.nodes[0], this.nodes[1], share);
    if (!this.loop && i === 0) return this.parabola(1, u);
    if (!this.loop && i === last - 1) return this.parabola(i, u);
    return mixedStates(this.parabola(i, u), this.parabola(i + 1, u), share);
  }

  // The parabola through nodes i - 1, i and i + 1.
  parabola(i, u) {
    const [[k0, p0], [k1, p1], [k2, p2]] = [this.node(i - 1), this.node(i), this.node(i + 1)];
    const first = mixedStates(p0, p1, (u - k0) / (k1 - k0));
    const second = mixedStates(p1, p2, (u - k1) / (k2 - k1));
    return mixedStates(first, second, (u - k0) / (k2 - k0));
  }

  // Knot and state; in a loop, both go on beyond the ends. Once around, the quaternions may have changed their sign.
  node(index) {
    const last = this.nodes.length - 1;
    if (!this.loop) return [this.knots[index], this.nodes[index]];
    const turns = Math.floor(index / last);
    const state = this.nodes[index - turns * last];
    const knot = this.knots[index - turns * last] + turns * this.knots[last];
    const agrees = turns % 2 === 0 || quaternionDot(this.nodes[0], this.nodes[last]) > 0;
    return [knot, agrees ? state : { ...state, quat: state.quat.map((value) => -value) }];
  }
}

const quaternionDot = (a, b) => a.quat.reduce((sum, value, i) => sum + value * b.quat[i], 0);

// The keyframes' states; each quaternion has the sign that is nearer to the one before.
export function statesOf(keyframes) {
  const states = keyframes.map(({ eye, R, fov }) => ({
    eye,
    quat: quaternionOf(R),
    zoom: Math.log(Math.tan(radians(fov) / 2)),
  }));
  for (let i = 1; i < states.length; ++i) {
    if (quaternionDot(states[i - 1], states[i]) < 0) states[i].quat = states[i].quat.map((value) => -value);
  }
  return states;
}

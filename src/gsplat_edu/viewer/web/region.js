// The directions from which a scene was captured, as seen from the pivot. A drag beyond them is damped because no photo
// shows what lies there.

import { dot, plus, unit } from "./vectors.js";

const MOST_EYES = 300; // cameras; more are subsampled evenly
const NEIGHBOURS = 3; // per camera: directions on the way to each count as captured
const STEPS_BETWEEN = 4; // steps on each such way
const MARGIN = (5 * Math.PI) / 180; // undamped margin around the captured directions
const WIDEST_MARGIN = Math.PI / 4;
const SOFTNESS = (4 * Math.PI) / 180; // beyond the margin, damping grows by a factor of e per this angle
const COVERED = 1.5; // a drag across the window turns by this multiple of the captured angle
const LEAST_TURN = Math.PI / 4;
const MOST_TURN = Math.PI;

const angleOf = (cosine) => Math.acos(Math.min(1, Math.max(-1, cosine)));

export class Region {
  constructor(eyes) {
    const every = Math.max(1, Math.ceil(eyes.length / MOST_EYES));
    this.eyes = eyes.filter((_, i) => i % every === 0);
    this.seen = []; // directions of the cameras
    this.directions = []; // these and interpolated ones
    this.margin = MARGIN;
  }

  // Sets the point from which directions are measured.
  around(centre) {
    const directions = this.eyes
      .map((eye) => plus(eye, centre, -1))
      .filter((offset) => Math.hypot(...offset) > 0)
      .map(unit);
    const nearest = directions.map((a, i) =>
      directions
        .filter((_, j) => j !== i)
        .sort((b, c) => dot(a, c) - dot(a, b))
        .slice(0, NEIGHBOURS),
    );
    this.seen = directions;
    this.directions = [...directions];
    directions.forEach((a, i) => {
      for (const b of nearest[i]) {
        for (let step = 1; step < STEPS_BETWEEN; ++step) {
          const between = a.map((value, axis) => value + (step / STEPS_BETWEEN) * (b[axis] - value));
          if (Math.hypot(...between) > 1e-3) this.directions.push(unit(between));
        }
      }
    });
    // sparse cameras get a wider margin
    const gaps = directions
      .map((a, i) => (nearest[i].length ? angleOf(dot(a, nearest[i][0])) : 0))
      .sort((a, b) => a - b);
    this.margin = Math.min(WIDEST_MARGIN, MARGIN + 0.5 * (gaps[gaps.length >> 1] ?? 0));
  }

  // Angle between a direction and the nearest captured one; 0 if there are no cameras.
  distance(offset) {
    if (!this.directions.length) return 0;
    const direction = unit(offset);
    return angleOf(this.directions.reduce((best, other) => Math.max(best, dot(direction, other)), -1));
  }

  // Fraction of a turn that is applied at a distance from the captured directions.
  share(distance, allowed) {
    return Math.exp(-Math.max(0, distance - allowed) / SOFTNESS);
  }

  // Radians per drag across the window's longer side: narrow captures turn slowly.
  turn() {
    if (!this.seen.length) return MOST_TURN;
    let widest = 1;
    for (const a of this.seen) for (const b of this.seen) widest = Math.min(widest, dot(a, b));
    return Math.min(MOST_TURN, Math.max(LEAST_TURN, COVERED * angleOf(widest)));
  }
}

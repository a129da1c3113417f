// The directions that a scene was captured from, seen from the point that the view orbits around. A drag that leaves
// them is slowed down: what lies beyond was on no photo.
"use strict";

const MOST_EYES = 300; // of cameras; more are thinned evenly
const NEIGHBOURS = 3; // of each camera: the way to each of them counts as captured
const STEPS_BETWEEN = 4; // parts of such a way
const MARGIN = (5 * Math.PI) / 180; // that is free around the captured directions
const WIDEST_MARGIN = Math.PI / 4;
const SOFTNESS = (4 * Math.PI) / 180; // beyond it, a drag turns by 1/e as much for every such angle
const COVERED = 1.5; // a drag across the window turns by this many times the captured angle
const LEAST_TURN = Math.PI / 4;
const MOST_TURN = Math.PI;

const unit = (a) => {
  const length = Math.hypot(...a);
  return a.map((value) => value / length);
};
const angleOf = (cosine) => Math.acos(Math.min(1, Math.max(-1, cosine)));

class Region {
  constructor(eyes) {
    const every = Math.max(1, Math.ceil(eyes.length / MOST_EYES));
    this.eyes = eyes.filter((_, i) => i % every === 0);
    this.seen = []; // directions of the cameras
    this.directions = []; // those, and some on the ways between them
    this.margin = MARGIN;
  }

  // Sets the point that directions are seen from.
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
    // sparse cameras leave more room between them
    const gaps = directions.map((a, i) => (nearest[i].length ? angleOf(dot(a, nearest[i][0])) : 0)).sort((a, b) => a - b);
    this.margin = Math.min(WIDEST_MARGIN, MARGIN + 0.5 * (gaps[gaps.length >> 1] ?? 0));
  }

  // Angle between a direction and the nearest captured one; 0 where nothing is known of the cameras.
  distance(offset) {
    if (!this.directions.length) return 0;
    const direction = unit(offset);
    return angleOf(this.directions.reduce((best, other) => Math.max(best, dot(direction, other)), -1));
  }

  // What share of a turn is carried out that leads from one distance to a larger one.
  share(distance, allowed) {
    return Math.exp(-Math.max(0, distance - allowed) / SOFTNESS);
  }

  // Radians for a drag across the longer side of the window: narrow captures turn slowly.
  turn() {
    if (!this.seen.length) return MOST_TURN;
    let widest = 1;
    for (const a of this.seen) for (const b of this.seen) widest = Math.min(widest, dot(a, b));
    return Math.min(MOST_TURN, Math.max(LEAST_TURN, COVERED * angleOf(widest)));
  }
}

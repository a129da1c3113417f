// A smooth movement of the view from one camera to another.

import { mixedStates, rotationOf, statesOf } from "./path.js";

const FLIGHT = 900; // milliseconds

export class Flight {
  constructor(from, to) {
    this.to = to;
    const stateOf = ({ R, eye, fy, H }) => ({ R, eye, fov: (2 * Math.atan((0.5 * H) / fy) * 180) / Math.PI });
    this.ends = statesOf([stateOf(from), stateOf(to)]);
    this.began = null;
  }

  // The camera at a time; null once the flight has ended. It starts and ends slowly.
  camera(now) {
    this.began ??= now;
    const share = (now - this.began) / FLIGHT;
    if (share >= 1) return null;
    const { eye, quat, zoom } = mixedStates(...this.ends, share * share * (3 - 2 * share));
    const { to } = this;
    const enlarged = (0.5 * to.H) / Math.exp(zoom) / to.fy;
    return { ...to, eye, R: rotationOf(quat), fx: to.fx * enlarged, fy: to.fy * enlarged };
  }
}

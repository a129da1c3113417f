// How long a training is, how much memory it takes, and how long it still runs.

import { PLANNED_VIEWS, RECIPE, RECIPE_ITERATIONS } from "./recipe.js";

export const QUALITIES = { draft: 1, standard: 3, high: 10 }; // multiples of a capture's unit of iterations

const UNIT = 1000; // the numbers of gsplat_edu/train/length.py, which says where they come from
const RANDOM_START = 1.25;
const VISITS = 125;
const LONGEST = 100_000;

const GROWN = RECIPE.fast_full_size / RECIPE_ITERATIONS; // share of a training after which it has all its Gaussians
const GROWING = 0.75; // share of a step's time that is proportional to the Gaussians, measured on the example
const GAUSSIAN = 59 * 4 * 4; // bytes: parameters up to degree 3, gradients and two moments, float32
const FRAME = 400; // bytes for each pixel of the largest photo: lists of tiles, images and their gradients

// Iterations of a quality; measured: whether the start points are points of the scene. The twin of planned_iterations in
// gsplat_edu/train/length.py.
export function plannedIterations(quality, views, measured) {
  const unit = Math.min(UNIT * Math.max(1, views / PLANNED_VIEWS) * (measured ? 1 : RANDOM_START), VISITS * views);
  const whole = Math.floor(Math.min(QUALITIES[quality] * unit, LONGEST));
  const digits = String(whole).startsWith("1") ? 3 : 2;
  const step = 10 ** Math.max(String(whole).length - digits, 0);
  return Math.floor(whole / step) * step;
}

// Seconds for the remaining steps, from the seconds of a step now. count, planned: Gaussians now and at `GROWN`, until which
// their number grows evenly.
export function secondsLeft({ steps, iterations, perStep, count, planned }) {
  const growing = Math.min(steps, Math.max(0, GROWN * iterations - (iterations - steps)));
  const full = growing ? Math.max(count, planned) : count;
  const mean = steps ? (growing * (count + full) * 0.5 + (steps - growing) * full) / steps : count;
  return steps * perStep * (1 - GROWING + (GROWING * mean) / Math.max(1, count));
}

// Bytes that a training takes: photos, Gaussians and what a step needs. views: [{camera}].
export function bytesNeeded(views, planned) {
  const pixels = views.map(({ camera: { W, H } }) => W * H);
  return 3 * pixels.reduce((sum, each) => sum + each, 0) + GAUSSIAN * planned + FRAME * Math.max(...pixels);
}

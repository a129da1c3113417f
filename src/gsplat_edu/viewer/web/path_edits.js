// Changes of a camera path. Each function returns a new path, and the place of a changed view where that may differ.

import { PathCurve } from "./path.js";

export const PATH_GAP = 0.01; // least seconds between views that the page writes
const LEAST_REST = 0.001; // seconds

export const restOf = ({ hold }) => hold ?? 0;

const segmentsOf = ({ keyframes, loop }) => keyframes.length - (loop ? 0 : 1);
const isTimed = ({ keyframes }) => keyframes[0]?.time !== undefined;
const meanTime = (keyframes) => (keyframes.at(-1).time - keyframes[0].time) / (keyframes.length - 1);

// The times at which a path meets its views, from 0; evenly if they are all at one place.
export function timesOf(path) {
  const { keyframes } = path;
  if (isTimed(path)) return keyframes.map(({ time }) => time - keyframes[0].time);
  const { stops, length, seconds } = new PathCurve(path);
  return stops.map((stop, i) => seconds * (length > 0 ? stop / length : i / segmentsOf(path)));
}

// The path with its views in the order of their times: each begins after the rest at the one before, the first at 0.
// A loop ends after its last view.
function arranged(path) {
  const keyframes = [...path.keyframes].sort((a, b) => a.time - b.time);
  const begin = keyframes[0].time;
  let free = 0;
  const moved = keyframes.map((keyframe) => {
    const time = Math.max(keyframe.time - begin, free);
    free = time + restOf(keyframe) + PATH_GAP;
    return { ...keyframe, time };
  });
  return { ...path, keyframes: moved, duration: path.loop ? Math.max(path.duration, free) : null };
}

// The path with a time for each view; the views may get other properties first.
function timed(path, change) {
  const times = timesOf(path);
  const keyframes = path.keyframes.map((keyframe, i) => change({ ...keyframe, time: times[i] }, i));
  return { ...path, keyframes, duration: path.loop ? new PathCurve(path).seconds : null };
}

// The path after a change of its number of segments. It lasts as long as its keyframes' times say, or as long per
// segment as before; a loop with times needs time for the way back.
export function grown(path, changes) {
  const next = { ...path, ...changes, duration: null };
  const last = next.keyframes.at(-1);
  if (last?.time === undefined) {
    const pace = !isTimed(path) && segmentsOf(path) > 0 ? path.duration / segmentsOf(path) : 0;
    next.duration = pace * segmentsOf(next) || null;
  } else if (next.loop) next.duration = last.time + restOf(last) - next.keyframes[0].time + meanTime(next.keyframes);
  return next;
}

// Adds a view at the end. On a path with times, it follows after the mean time between the others.
export function appended(path, view) {
  const { keyframes } = path;
  const last = keyframes.at(-1);
  const time = isTimed(path) ? { time: last.time + restOf(last) + meanTime(keyframes) } : {};
  return grown(path, { keyframes: [...keyframes, { ...view, ...time }] });
}

// Adds a view at a time in seconds from the first; halfway to the next view if a view is there, at the end if no view
// comes later.
export function inserted(path, view, at) {
  const { keyframes } = path;
  const times = timesOf(path);
  const after = times.filter((time) => time <= at + PATH_GAP).length;
  if (after === keyframes.length && at <= times.at(-1) + PATH_GAP)
    return { path: appended(path, view), chosen: keyframes.length };
  const end = times[after - 1] + restOf(keyframes[after - 1]);
  const next = times[after] ?? new PathCurve(path).seconds;
  const seconds = at < end + PATH_GAP || at > next - PATH_GAP ? (end + next) / 2 : at;
  const placed = isTimed(path) ? { ...view, time: keyframes[0].time + seconds } : view;
  const more = [...keyframes.slice(0, after), placed, ...keyframes.slice(after)];
  const longer = isTimed(path) ? arranged({ ...path, keyframes: more }) : grown(path, { keyframes: more });
  return { path: longer, chosen: after };
}

// Moves a view to a time, in seconds from the first, rounded to milliseconds; others stay, or are pushed later.
export function withTime(path, index, seconds) {
  const marked = timed(path, (keyframe, i) =>
    i === index ? { ...keyframe, time: Math.round(seconds * 1000) / 1000, here: true } : keyframe,
  );
  const sorted = arranged(marked);
  const chosen = sorted.keyframes.findIndex(({ here }) => here);
  return { path: { ...sorted, keyframes: sorted.keyframes.map(({ here, ...keyframe }) => keyframe) }, chosen };
}

// Rests at a view for some seconds; later views may be pushed later.
export function withRest(path, index, seconds) {
  const hold = seconds >= LEAST_REST ? seconds : undefined;
  return arranged(timed(path, (keyframe, i) => (i === index ? { ...keyframe, hold } : keyframe)));
}

// Makes the whole path last a number of seconds.
export function lasting(path, seconds) {
  const all = Math.max(seconds, PATH_GAP * 2 * path.keyframes.length);
  if (!isTimed(path)) return { ...path, duration: all };
  const by = all / new PathCurve(path).seconds;
  const scaled = timed(path, ({ hold, ...keyframe }) => ({
    ...keyframe,
    time: by * keyframe.time,
    ...(hold ? { hold: by * hold } : {}),
  }));
  return arranged({ ...scaled, duration: all });
}

// Exchanges two views; each place keeps its time.
export function swapped(path, index, other) {
  const { keyframes } = path;
  const views = [...keyframes];
  [views[index], views[other]] = [views[other], views[index]];
  const placed = views.map((view, i) => (isTimed(path) ? { ...view, time: keyframes[i].time } : view));
  return isTimed(path) ? arranged({ ...path, keyframes: placed }) : { ...path, keyframes: placed };
}

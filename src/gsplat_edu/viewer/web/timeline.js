// The camera path as a strip of time: a marker for each view, and a playhead.

import { element } from "./common.js";
import { PathCurve } from "./path.js";

const PATH_GAP = 0.01; // least seconds between views that the page writes
const NEAR_MARKER = 22; // CSS pixels beside a marker that still press it
const RULER = 20; // CSS pixels at the strip's top, which move the playhead
const MOVED = 3; // CSS pixels after which a press becomes a drag
const STRIP_ROOM = 1.1; // the strip shows this multiple of the path's time, so that the last view can be moved later
const FINE_STEP = 0.1;
const COARSE_STEP = 1; // seconds, with Shift

const shortSeconds = (seconds) => `${Number(seconds.toFixed(2))} s`;
export const restOf = ({ hold }) => hold ?? 0;

// The times at which a path meets its views, from 0; evenly if they are all at one place.
function timesOf(path) {
  const { keyframes } = path;
  if (keyframes[0].time !== undefined) return keyframes.map(({ time }) => time - keyframes[0].time);
  const { stops, length, seconds } = new PathCurve(path);
  const segments = keyframes.length - (path.loop ? 0 : 1);
  return stops.map((stop, i) => seconds * (length > 0 ? stop / length : i / segments));
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
function timed(path, change = (keyframe) => keyframe) {
  const times = timesOf(path);
  const keyframes = path.keyframes.map((keyframe, i) => change({ ...keyframe, time: times[i] }, i));
  return { ...path, keyframes, duration: path.loop ? new PathCurve(path).seconds : null };
}

export class Timeline {
  // keyframes: the Keyframes whose path is shown.
  constructor(keyframes) {
    Object.assign(this, { keyframes, at: 0, chosen: 0, press: null, markers: [], bars: [] });
    this.strip = element("strip");
    this.playhead = element("playhead");
    const listen = (name, method) => this.strip.addEventListener(name, (event) => method.call(this, event));
    listen("pointerdown", this.down);
    listen("pointermove", this.move);
    listen("pointerup", this.up);
    listen("pointercancel", () => {
      this.press = null;
      this.draw();
    });
    listen("keydown", this.key);
    const fields = {
      "path-seconds": (value) => this.last(value),
      "view-time": (value) => this.setTime(this.chosen, value),
      "view-rest": (value) => this.rest(value),
    };
    for (const [id, set] of Object.entries(fields)) {
      element(id).addEventListener("change", ({ target: { value } }) =>
        value !== "" && value >= 0 ? set(Number(value)) : this.draw(),
      );
    }
    element("path-ease").addEventListener("change", ({ target: { value } }) =>
      this.set({ ...this.path, ease: value || null }),
    );
    element("insert-view").addEventListener("click", () => this.insert());
    element("replace-view").addEventListener("click", () => this.replace());
    element("view-earlier").addEventListener("click", () => this.swap(-1));
    element("view-later").addEventListener("click", () => this.swap(1));
    // what is typed into a field is no key of the page
    element("timeline").addEventListener("keydown", (event) => {
      if (!event.target.matches("input, select")) return;
      event.stopPropagation();
      if (event.key === "Escape") event.target.blur();
    });
  }

  get path() {
    return this.keyframes.path;
  }

  // Stores a changed path, and chooses a view of it.
  set(path, chosen = this.chosen) {
    this.chosen = chosen;
    this.keyframes.set(path);
  }

  // The path has changed.
  changed() {
    element("timeline").hidden = !this.keyframes.playable;
    this.press = null;
    if (!this.keyframes.playable) return (this.at = 0);
    this.curve = this.keyframes.curve();
    this.at = Math.min(this.at, this.curve.seconds);
    this.chosen = Math.min(this.chosen, this.path.keyframes.length - 1);
    return this.draw();
  }

  // Seconds at which playing starts: the playhead, or 0 if the playhead is at the end.
  get from() {
    return this.at < this.curve.seconds - PATH_GAP ? this.at : 0;
  }

  // The picture shows the path at a time; a loop repeats.
  reached(seconds) {
    const { loop, seconds: all } = this.curve;
    this.at = loop ? seconds % all : Math.min(seconds, all);
    this.drawPlayhead();
  }

  goTo(seconds) {
    this.reached(Math.min(Math.max(seconds, 0), this.curve.seconds - (this.curve.loop ? 1e-9 : 0)));
    const { keyframes } = this;
    keyframes.actions.goToView(keyframes.camera(this.curve.pose(this.at)));
  }

  choose(index) {
    this.chosen = index;
    this.goTo(timesOf(this.path)[index]);
    this.draw();
  }

  // Moves a view to a time, in seconds from the first; others stay, or are pushed later. Returns the path and the view's
  // place in it.
  moved(index, seconds) {
    const path = timed(this.path, (keyframe, i) =>
      i === index ? { ...keyframe, time: Math.round(seconds * 1000) / 1000, here: true } : keyframe,
    );
    const sorted = arranged(path);
    const chosen = sorted.keyframes.findIndex(({ here }) => here);
    return { path: { ...sorted, keyframes: sorted.keyframes.map(({ here, ...keyframe }) => keyframe) }, chosen };
  }

  setTime(index, seconds) {
    const { path, chosen } = this.moved(index, seconds);
    this.set(path, chosen);
  }

  rest(seconds) {
    const hold = seconds >= 0.001 ? seconds : undefined;
    this.set(arranged(timed(this.path, (keyframe, i) => (i === this.chosen ? { ...keyframe, hold } : keyframe))));
  }

  // Makes the whole path last a number of seconds.
  last(seconds) {
    const all = Math.max(seconds, PATH_GAP * 2 * this.path.keyframes.length);
    if (this.path.keyframes[0].time === undefined) return this.set({ ...this.path, duration: all });
    const by = all / this.curve.seconds;
    const scaled = timed(this.path, ({ hold, ...keyframe }) => ({
      ...keyframe,
      time: by * keyframe.time,
      ...(hold ? { hold: by * hold } : {}),
    }));
    return this.set(arranged({ ...scaled, duration: all }));
  }

  // Exchanges the chosen view with a neighbour; each place keeps its time.
  swap(by) {
    const { keyframes } = this.path;
    const other = this.chosen + by;
    if (!keyframes[other]) return;
    const times = keyframes.map(({ time }) => time);
    const swapped = [...keyframes];
    [swapped[this.chosen], swapped[other]] = [swapped[other], swapped[this.chosen]];
    const placed = swapped.map((keyframe, i) => (times[i] === undefined ? keyframe : { ...keyframe, time: times[i] }));
    const path = { ...this.path, keyframes: placed };
    this.set(times[0] === undefined ? path : arranged(path), other);
  }

  replace() {
    const view = this.keyframes.current();
    const place = (keyframe, i) => (i === this.chosen ? { ...keyframe, ...view } : keyframe);
    this.set({ ...this.path, keyframes: this.path.keyframes.map(place) });
  }

  // Adds the current view at the playhead; halfway to the next view if a view is there.
  insert() {
    const times = timesOf(this.path);
    const { keyframes } = this.path;
    const after = times.filter((time) => time <= this.at + PATH_GAP).length;
    if (after === keyframes.length && this.at <= times.at(-1) + PATH_GAP) {
      this.chosen = keyframes.length;
      return this.keyframes.save();
    }
    const end = times[after - 1] + restOf(keyframes[after - 1]);
    const next = times[after] ?? this.curve.seconds;
    const time = this.at < end + PATH_GAP || this.at > next - PATH_GAP ? (end + next) / 2 : this.at;
    const more = [...keyframes.slice(0, after), this.keyframes.current(), ...keyframes.slice(after)];
    if (keyframes[0].time === undefined) return this.set(this.keyframes.grown({ keyframes: more }), after);
    const base = keyframes[0].time;
    const placed = more.map((keyframe, i) => (i === after ? { ...keyframe, time: base + time } : keyframe));
    return this.set(arranged({ ...this.path, keyframes: placed }), after);
  }

  // Seconds at a column of the window.
  secondsAt(x) {
    const { left, width } = this.strip.getBoundingClientRect();
    return ((x - left) / width) * this.span;
  }

  down(event) {
    if (event.button !== 0) return;
    event.preventDefault();
    this.strip.setPointerCapture(event.pointerId);
    const { top, left, width } = this.strip.getBoundingClientRect();
    const apart = timesOf(this.path).map((time) => Math.abs(left + (time / this.span) * width - event.clientX));
    const nearest = apart.indexOf(Math.min(...apart));
    const index = event.clientY - top > RULER && apart[nearest] <= NEAR_MARKER ? nearest : -1;
    this.press = {
      index,
      x: event.clientX,
      grip: index < 0 ? 0 : timesOf(this.path)[index] - this.secondsAt(event.clientX),
      moved: null,
    };
    (index < 0 ? this.playhead : this.markers[index]).focus();
    if (index < 0) this.goTo(this.secondsAt(event.clientX));
  }

  move({ clientX }) {
    const { press } = this;
    if (!press) return;
    if (press.index < 0) this.goTo(this.secondsAt(clientX));
    else if (press.moved || Math.abs(clientX - press.x) > MOVED) {
      press.moved = this.moved(press.index, this.secondsAt(clientX) + press.grip);
      this.draw(press.moved.path, press.moved.chosen);
    }
  }

  up() {
    const { press } = this;
    this.press = null;
    if (!press || press.index < 0) return;
    if (press.moved) this.set(press.moved.path, press.moved.chosen);
    else this.choose(press.index);
    this.markers[this.chosen].focus();
  }

  key(event) {
    const { key, shiftKey, target } = event;
    const index = this.markers.indexOf(target);
    const step = shiftKey ? COARSE_STEP : FINE_STEP;
    const by = {
      ArrowLeft: -step,
      ArrowDown: -step,
      ArrowRight: step,
      ArrowUp: step,
      PageDown: -COARSE_STEP,
      PageUp: COARSE_STEP,
    }[key];
    const ends = { Home: 0, End: this.curve.seconds }[key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (index >= 0 && (key === "Enter" || key === " ")) this.choose(index);
    else if (index >= 0 && by) {
      this.setTime(index, timesOf(this.path)[index] + by);
      this.markers[this.chosen].focus();
    } else if (target === this.playhead && (by || ends !== undefined)) this.goTo(ends ?? this.at + by);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  // Shows a path: that of the page, or what a drag would make of it.
  draw(path = this.path, chosen = this.chosen) {
    if (!this.keyframes.playable) return;
    const { keyframes } = path;
    const times = timesOf(path);
    if (!this.press) this.span = STRIP_ROOM * this.curve.seconds;
    while (this.markers.length > keyframes.length) for (const list of [this.markers, this.bars]) list.pop().remove();
    while (this.markers.length < keyframes.length) this.add();
    const share = (seconds) => `${100 * Math.min(Math.max(seconds / this.span, 0), 1)}%`;
    keyframes.forEach((keyframe, i) => {
      const [marker, bar] = [this.markers[i], this.bars[i]];
      marker.style.left = bar.style.left = share(times[i]);
      bar.style.width = share(restOf(keyframe));
      marker.setAttribute("aria-current", i === chosen);
      this.describe(marker, times[i], `view ${i + 1} of ${keyframes.length}`);
    });
    element("rail").style.width = share(path === this.path ? this.curve.seconds : times.at(-1));
    this.drawFields(path, times, chosen);
    this.drawPlayhead();
  }

  add() {
    const marker = document.createElement("button");
    marker.textContent = this.markers.length + 1;
    marker.className = "marker";
    marker.setAttribute("role", "slider");
    marker.setAttribute("aria-label", `time of view ${this.markers.length + 1}`);
    const bar = document.createElement("span");
    bar.className = "rest";
    this.strip.append(bar, marker);
    this.markers.push(marker);
    this.bars.push(bar);
  }

  describe(slider, seconds, what) {
    slider.setAttribute("aria-valuemin", 0);
    slider.setAttribute("aria-valuemax", Number(this.span.toFixed(2)));
    slider.setAttribute("aria-valuenow", Number(seconds.toFixed(2)));
    slider.setAttribute("aria-valuetext", `${what}${what ? ", " : ""}${shortSeconds(seconds)}`);
  }

  drawFields(path, times, chosen) {
    const fill = (id, value) => {
      if (element(id) !== document.activeElement || this.press) element(id).value = Number(value.toFixed(2));
    };
    const keyframe = path.keyframes[chosen];
    fill(
      "path-seconds",
      path === this.path ? this.curve.seconds : (path.duration ?? times.at(-1) + restOf(path.keyframes.at(-1))),
    );
    fill("view-time", times[chosen]);
    fill("view-rest", restOf(keyframe));
    element("path-ease").value = path.ease ?? "";
    element("chosen-view").textContent = `view ${chosen + 1}`;
    element("view-earlier").setAttribute("aria-disabled", chosen === 0); // a disabled button would lose the focus
    element("view-later").setAttribute("aria-disabled", chosen === path.keyframes.length - 1);
    element("replace-view").hidden = Boolean(keyframe.given);
  }

  drawPlayhead() {
    this.playhead.style.left = `${(100 * Math.min(this.at, this.span)) / this.span}%`;
    this.describe(this.playhead, this.at, "");
  }
}

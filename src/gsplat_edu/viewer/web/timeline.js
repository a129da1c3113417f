// The camera path as a strip of time: a marker for each view, and a playhead.

import { element } from "./common.js";
import { inserted, lasting, PATH_GAP, restOf, swapped, timesOf, withRest, withTime } from "./path_edits.js";

const NEAR_MARKER = 22; // CSS pixels beside a marker that still press it
const RULER = 20; // CSS pixels at the strip's top, which move the playhead
const MOVED = 3; // CSS pixels after which a press becomes a drag
const STRIP_ROOM = 1.1; // the strip shows this multiple of the path's time, so that the last view can be moved later
const FINE_STEP = 0.1;
const COARSE_STEP = 1; // seconds, with Shift

const shortSeconds = (seconds) => `${Number(seconds.toFixed(2))} s`;

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
      "path-seconds": (value) => this.set(lasting(this.path, value)),
      "view-time": (value) => this.setTime(this.chosen, value),
      "view-rest": (value) => this.set(withRest(this.path, this.chosen, value)),
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

  setTime(index, seconds) {
    const { path, chosen } = withTime(this.path, index, seconds);
    this.set(path, chosen);
  }

  // Exchanges the chosen view with a neighbour.
  swap(by) {
    const other = this.chosen + by;
    if (this.path.keyframes[other]) this.set(swapped(this.path, this.chosen, other), other);
  }

  replace() {
    const view = this.keyframes.current();
    const place = (keyframe, i) => (i === this.chosen ? { ...keyframe, ...view } : keyframe);
    this.set({ ...this.path, keyframes: this.path.keyframes.map(place) });
  }

  // Adds the current view at the playhead.
  insert() {
    const { path, chosen } = inserted(this.path, this.keyframes.current(), this.at);
    this.set(path, chosen);
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
      press.moved = withTime(this.path, press.index, this.secondsAt(clientX) + press.grip);
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

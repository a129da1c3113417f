// The editor's bar chart of opacities, sizes or distances, on which a range of splats is selected.

import { element, followSize } from "./common.js";
import { SELECTED } from "./edit_flags.js";
import { shortNumber } from "./edit_shapes.js";

const BAR_STEPS = 4; // steps of a handle per bar
const RANGE_STEPS = 200; // steps of a handle over the whole chart
const CHART_HEIGHT = 90; // CSS pixels
const LEAST_DISTANCE = 1e-6; // of the largest one: smaller ones lie in the first bar

export const HISTOGRAM_PANEL = `
<details id="edit-histogram"><summary>By opacity, size or distance</summary>
<p class="row"><label>of <select id="edit-quantity"><option value="opacity">opacity</option><option value="size">size</option>
<option value="distance">distance to the pivot</option></select></label></p>
<canvas id="edit-chart" role="img" aria-label="bar chart"></canvas>
<p class="row"><label>from <input id="edit-low" type="range" min="0" max="${RANGE_STEPS}" value="0"></label>
<output id="edit-low-text" for="edit-low"></output></p>
<p class="row"><label>to <input id="edit-high" type="range" min="0" max="${RANGE_STEPS}" value="${RANGE_STEPS}"></label>
<output id="edit-high-text" for="edit-high"></output></p>
<p class="row"><button data-do="select-range">select range</button></p>
<p class="soft">Heights are logarithmic. A handle at the end sets no limit.</p>
</details>`;

// The horizontal axis of each quantity: the coordinate of splat i, and the value at a coordinate.
const QUANTITIES = {
  opacity: {
    of:
      ({ logits }) =>
      (i) =>
        1 / (1 + Math.exp(-logits[i])),
    value: (x) => x,
    fixed: [0, 1],
  },
  size: {
    of:
      ({ log_scales: s }) =>
      (i) =>
        Math.max(s[3 * i], s[3 * i + 1], s[3 * i + 2]),
    value: Math.exp,
  },
  distance: {
    of:
      ({ means: m }, [x, y, z]) =>
      (i) =>
        Math.log(Math.sqrt((m[3 * i] - x) ** 2 + (m[3 * i + 1] - y) ** 2 + (m[3 * i + 2] - z) ** 2)),
    value: Math.exp,
  },
};

// Counts visible and selected splats per bar; a splat without a finite place counts in the nearest bar.
export function counted(name, values, flags, pivot) {
  const quantity = QUANTITIES[name];
  const of = quantity.of(values, pivot);
  const places = new Float64Array(values.count);
  let [low, high] = [Infinity, -Infinity];
  for (let i = 0; i < values.count; ++i) {
    places[i] = flags[i] <= SELECTED ? of(i) : NaN;
    if (places[i] < low && places[i] > -Infinity) low = places[i];
    if (places[i] > high && places[i] < Infinity) high = places[i];
  }
  if (name === "distance") low = Math.max(low, high + Math.log(LEAST_DISTANCE));
  if (quantity.fixed) [low, high] = quantity.fixed;
  if (!(high > low)) [low, high] = low === high ? [low - 1, high + 1] : [0, 1];
  const bars = RANGE_STEPS / BAR_STEPS;
  const [all, selected] = [new Uint32Array(bars), new Uint32Array(bars)];
  const scale = bars / (high - low);
  for (let i = 0; i < values.count; ++i) {
    if (Number.isNaN(places[i])) continue;
    const bar = Math.min(Math.max(Math.floor((places[i] - low) * scale), 0), bars - 1);
    ++all[bar];
    if (flags[i] === SELECTED) ++selected[bar];
  }
  return { ends: [low, high], all, selected };
}

export class EditHistogram {
  constructor(editor) {
    this.editor = editor;
    this.root = element("edit-histogram");
    this.canvas = element("edit-chart");
    this.handles = [element("edit-low"), element("edit-high")];
    this.pivot = null; // of the distances that are shown
    this.ends = null; // of the axis, before it is counted
    this.asked = 0;
    this.held = null; // the handle that a pointer drags
    this.root.addEventListener("toggle", () => this.changed());
    element("edit-quantity").addEventListener("input", () => this.reset());
    this.root.addEventListener("keydown", (event) => this.pressed(event));
    this.handles.forEach((handle, k) => handle.addEventListener("input", () => this.moved(k)));
    this.canvas.addEventListener("pointerdown", (event) => this.down(event));
    this.canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, () => (this.held = null));
    matchMedia("(prefers-color-scheme: light)").addEventListener("change", () => this.changed());
    followSize(this.canvas, () => this.changed());
  }

  get quantity() {
    return element("edit-quantity").value;
  }

  // The splats' states have changed, or the chart is opened.
  changed() {
    if (!this.root.open) return;
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      this.count();
      this.draw();
    });
  }

  // The view has moved, perhaps its pivot too.
  viewed() {
    if (this.quantity !== "distance" || !this.pivot) return;
    if (this.editor.viewer.view.focus.some((x, k) => x !== this.pivot[k])) this.changed();
  }

  // Enter on a handle selects, and does not apply the tool.
  pressed(event) {
    if (event.key !== "Enter" || !this.handles.includes(event.target)) return;
    event.stopPropagation();
    this.select();
  }

  // Another quantity is shown.
  reset() {
    this.ends = null;
    [this.handles[0].value, this.handles[1].value] = [0, RANGE_STEPS];
    this.changed();
  }

  count() {
    const { values, history, viewer } = this.editor;
    this.pivot = [...viewer.view.focus];
    ({
      ends: this.ends,
      all: this.all,
      selected: this.selected,
    } = counted(this.quantity, values, history.flags, this.pivot));
  }

  // The value at a step of a handle; null at its end, where it sets no limit.
  valueAt(k) {
    const step = Number(this.handles[k].value);
    if (step === [0, RANGE_STEPS][k]) return null;
    const [low, high] = this.ends;
    return QUANTITIES[this.quantity].value(low + (step / RANGE_STEPS) * (high - low));
  }

  draw() {
    const { canvas } = this;
    const [width, ratio] = [canvas.clientWidth, devicePixelRatio];
    [canvas.width, canvas.height] = [width, CHART_HEIGHT].map((size) => Math.round(size * ratio));
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    const style = getComputedStyle(element("edit"));
    const highest = Math.log1p(Math.max(...this.all)) || 1;
    const bars = this.all.length;
    const bar = (counts, k) => {
      const height = (Math.log1p(counts[k]) / highest) * (CHART_HEIGHT - 2);
      context.fillRect((k * width) / bars, CHART_HEIGHT - height, width / bars - 0.5, height);
    };
    for (let k = 0; k < bars; ++k) {
      context.fillStyle = style.getPropertyValue("--bar");
      bar(this.all, k);
      context.fillStyle = style.getPropertyValue("--chosen");
      bar(this.selected, k);
    }
    const [from, to] = this.handles.map(({ value }) => (value / RANGE_STEPS) * width);
    context.fillStyle = style.getPropertyValue("--outside");
    context.fillRect(0, 0, from, CHART_HEIGHT);
    context.fillRect(to, 0, width - to, CHART_HEIGHT);
    context.fillStyle = style.getPropertyValue("--text");
    for (const x of [from, to]) context.fillRect(Math.min(Math.max(x - 1, 0), width - 2), 0, 2, CHART_HEIGHT);
    this.describe();
  }

  // Writes the limits beside the handles, and describes the chart.
  describe() {
    const number = (counts) => counts.reduce((a, b) => a + b, 0).toLocaleString("en");
    const [low, high] = this.ends.map((x) => this.textOf(QUANTITIES[this.quantity].value(x)));
    this.canvas.setAttribute(
      "aria-label",
      `${this.quantity} of ${number(this.all)} splats, from ${low} to ${high}; ${number(this.selected)} are selected`,
    );
    this.handles.forEach((handle, k) => {
      const value = this.valueAt(k);
      const text = value === null ? `no limit (${[low, high][k]})` : this.textOf(value);
      handle.setAttribute("aria-valuetext", text);
      element(`${handle.id}-text`).textContent = text;
    });
  }

  textOf(value) {
    return this.quantity === "opacity" ? shortNumber(value) : this.editor.textOf(value);
  }

  // A handle was moved; it pushes the other one.
  moved(k) {
    const [low, high] = this.handles.map(({ value }) => Number(value));
    if (low > high) this.handles[1 - k].value = this.handles[k].value;
    if (this.ends) this.draw();
  }

  down(event) {
    event.preventDefault();
    this.canvas.setPointerCapture(event.pointerId);
    const step = this.stepAt(event);
    const [low, high] = this.handles.map(({ value }) => Number(value));
    const nearer = Math.abs(step - low) - Math.abs(step - high);
    this.held = nearer < 0 || (nearer === 0 && step < low) ? 0 : 1;
    this.handles[this.held].focus();
    this.drag(event);
  }

  drag(event) {
    if (this.held === null) return;
    this.handles[this.held].value = this.stepAt(event);
    this.moved(this.held);
  }

  stepAt({ clientX }) {
    const { left, width } = this.canvas.getBoundingClientRect();
    return Math.round((RANGE_STEPS * (clientX - left)) / width);
  }

  select() {
    const { editor } = this;
    if (!this.ends) this.count();
    const [low, high] = [this.valueAt(0), this.valueAt(1)];
    if (this.quantity === "opacity") editor.selectOpacity(low ?? 0, high ?? 1);
    else if (this.quantity === "distance") editor.selectDistance(this.pivot, low, high);
    else editor.selectRange("size", ...[low, high].map((value) => value && Math.log(value)));
  }
}

// Small curves of a training: loss, PSNR and the number of splats over the iterations.

import { h } from "./patch.js";

const CURVE_WIDTH = 100; // units of the drawing, which is stretched to its place
const CURVE_HEIGHT = 24;

// One curve with its name and newest value.
export class Curve {
  // shown(value) makes the text of a value. weight: that of the newest value in a moving mean, at most 1.
  constructor(name, shown, weight) {
    Object.assign(this, { name, shown, weight });
    this.line = h("polyline", { fill: "none" });
    const box = { viewBox: `0 0 ${CURVE_WIDTH} ${CURVE_HEIGHT}`, preserveAspectRatio: "none", role: "img" };
    this.drawing = h("svg", box, this.line);
    this.value = h("span", { class: "value" });
    this.element = h("div", { class: "curve" }, h("span", {}, name), this.value, this.drawing);
    this.show(null, [], []);
  }

  // value: the newest, null if unknown. iterations, values: the points; a value may be null.
  show(value, iterations, values) {
    this.value.textContent = value === null ? "–" : this.shown(value);
    const points = iterations.map((x, i) => [x, values[i]]).filter(([, y]) => y !== null);
    for (let i = 1; i < points.length; ++i) points[i][1] += (1 - this.weight) * (points[i - 1][1] - points[i][1]);
    const heights = points.map(([, y]) => y);
    const [low, high] = [Math.min(...heights), Math.max(...heights)];
    const [first, last] = [points[0]?.[0] ?? 0, points.at(-1)?.[0] ?? 0];
    const across = (x) => (CURVE_WIDTH * (x - first)) / Math.max(1, last - first);
    const down = (y) => CURVE_HEIGHT - 1 - ((CURVE_HEIGHT - 2) * (y - low)) / (high - low || 1);
    this.line.setAttribute("points", points.map(([x, y]) => `${across(x).toFixed(2)},${down(y).toFixed(2)}`).join(" "));
    const range = points.length ? `, from ${this.shown(heights[0])} to ${this.shown(heights.at(-1))}` : "";
    this.drawing.setAttribute("aria-label", `${this.name} over the iterations${range}`);
  }
}

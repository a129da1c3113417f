// Curves over the iterations, with their range and newest value in words.

import { h, whole } from "./dom.js";

const [WIDTH, HEIGHT] = [300, 100]; // units of the drawing, which is stretched to its place
const MOST = 300; // points that are drawn

// One curve. shown(value) makes the text of a value.
export function curve(title, shown) {
  const path = h("path", { fill: "none", "vector-effect": "non-scaling-stroke" });
  const drawing = h("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", role: "img" }, path);
  const name = h("span", {}, title);
  const value = h("output", {}, "–");
  const [high, low, right] = [h("span", { class: "high" }), h("span", { class: "low" }), h("span", { class: "last" })];
  const axis = h(
    "div",
    { class: "axis quiet", "aria-hidden": "true" },
    h("span", {}, "0"),
    h("span", {}, "iteration"),
    right,
  );
  const element = h(
    "figure",
    { class: "curve card" },
    h("figcaption", {}, name, value),
    h("div", { class: "plot" }, high, low, drawing),
    axis,
  );

  // Shows values at iterations; a value may be null. `of` is what they were measured on, `planned` the last iteration.
  function show(iterations, values, of = "", planned = 0) {
    name.textContent = of ? `${title} ${of}` : title;
    const points = averaged(iterations.map((x, i) => [x, values[i]]).filter(([, y]) => Number.isFinite(y)));
    if (!points.length) {
      drawing.setAttribute("aria-label", `${title}: no values yet`);
      return;
    }
    const heights = points.map(([, y]) => y);
    const [least, most] = [Math.min(...heights), Math.max(...heights)];
    const last = points.at(-1)[0];
    const end = Math.max(last, planned);
    const across = (x) => (WIDTH * x) / Math.max(1, end);
    const down = (y) => HEIGHT - 4 - ((HEIGHT - 8) * (y - least)) / (most - least || 1);
    const line = points.map(([x, y]) => `${across(x).toFixed(1)} ${down(y).toFixed(1)}`);
    path.setAttribute("d", points.length > 1 ? `M${line.join("L")}` : `M${line[0]}h0`); // one value is a point
    path.classList.toggle("point", points.length === 1);
    value.textContent = shown(heights.at(-1));
    [high.textContent, low.textContent] = least === most ? ["", ""] : [shown(most), shown(least)];
    right.textContent = whole(end);
    const range = `from ${shown(heights[0])} to ${shown(heights.at(-1))} after ${whole(last)} iterations`;
    drawing.setAttribute("aria-label", `${title}: ${range}`);
  }

  show([], []);
  return { element, show };
}

// Neighbours are averaged, so that at most `MOST` points are left.
function averaged(points) {
  const apart = Math.ceil(points.length / MOST);
  if (apart <= 1) return points;
  const found = [];
  for (let i = 0; i < points.length; i += apart) {
    const some = points.slice(i, i + apart);
    found.push([some.at(-1)[0], some.reduce((sum, [, y]) => sum + y, 0) / some.length]);
  }
  return found;
}

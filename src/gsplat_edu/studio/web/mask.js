// Draw on the mask of a photo: rectangles, outlines and brush strokes by mouse, finger or keyboard; what they cover is not
// used.

import { at, get, post } from "./api.js";
import { announce, attempt, button, commandLine, count, errorLine, h, heading, patch, put, want } from "./dom.js";

const STEP = 50; // presses of an arrow key across the longer side; single pixels with Shift
const SPACE = 400; // points of an outline are at least this fraction of the longer side apart

const BRUSH = 40; // the brush's radius at first is this fraction of the longer side
const MOST_RADIUS = 4; // and the largest one this
const FACTOR = 1.25; // by which a key changes it
const MOST_POINTS = 1000; // in a stroke; a longer one becomes several

const lineOf = (points) => points.reduce((text, value, i) => text + (i ? (i % 2 ? " " : "L") : "") + value, "M");

const pathOf = (shape) => {
  if (shape.length === 4) return `M${shape[0]} ${shape[1]}H${shape[2]}V${shape[3]}H${shape[0]}Z`;
  return `${lineOf(shape)}Z`;
};

// A stroke {brush: radius, points} as an element, which has the brush's width; a stroke of one point is a dot.
const strokeOf = ({ brush, points }) => want("path", { d: `${lineOf(points)}h0`, "stroke-width": 2 * brush });

// Leaves out the points of an outline that lie within `slack` of the line between those kept (Douglas and Peucker).
export function simplified(points, slack) {
  if (points.length < 3) return points;
  const [[x0, y0], [x1, y1]] = [points[0], points.at(-1)];
  const length = Math.hypot(x1 - x0, y1 - y0);
  let [far, worst] = [0, 0];
  points.forEach(([x, y], i) => {
    const away = length ? Math.abs((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)) / length : Math.hypot(x - x0, y - y0);
    if (away > worst) [far, worst] = [i, away];
  });
  if (worst <= slack) return [points[0], points.at(-1)];
  return [...simplified(points.slice(0, far + 1), slack).slice(0, -1), ...simplified(points.slice(far), slack)];
}

// A shape from where the pointer was pressed, moved and released; null if it covers nothing.
function shapeOf(points, tool, slack, radius) {
  const [[x0, y0], [x1, y1]] = [points[0], points.at(-1)];
  if (tool === "rectangle")
    return x0 === x1 || y0 === y1 ? null : [Math.min(x0, x1), Math.min(y0, y1), Math.max(x0, x1), Math.max(y0, y1)];
  if (tool === "brush") return { brush: radius, points: simplified(points, Math.min(slack, radius / 8)).flat() };
  const outline = simplified(points, slack);
  return outline.length < 3 ? null : outline.flat();
}

// Joins the shapes drawn here, which began with `base`, and those that were saved elsewhere since: the others, without what
// was removed here, beneath what was added here.
export function joined(base, own, others) {
  const without = (shapes, taken) => {
    const left = taken.map((shape) => JSON.stringify(shape));
    return shapes.filter((shape) => {
      const index = left.indexOf(JSON.stringify(shape));
      if (index >= 0) left.splice(index, 1);
      return index < 0;
    });
  };
  const added = without(own, base);
  return [...without(without(others, added), without(base, own)), ...added];
}

// The photo on which shapes are drawn. changed() is called after each change; cross: where the keyboard points; tip: where
// the pointer is, for the circle that shows the brush.
function sheet(src, name, { W, H, shapes: given }, changed) {
  const longest = Math.max(W, H);
  const [done, trace, mark] = ["done", "trace", "cross"].map((kind) => h("path", { class: kind }));
  const [strokes, stroke] = ["strokes", "strokes trace"].map((kind) => h("g", { class: kind }));
  const circle = h("circle", { class: "tip" });
  const svg = h(
    "svg",
    {
      viewBox: `0 0 ${W} ${H}`,
      tabindex: "0",
      role: "application",
      "aria-label": `${name}: draw what is not used. Arrow keys move a cross, Enter presses and releases.`,
    },
    done,
    strokes,
    trace,
    stroke,
    mark,
    circle,
  );
  let [shapes, past, tool, points, cross, tip] = [given, [], "rectangle", null, null, null];
  let shown = null; // the shapes that are in the picture
  let radius = Math.max(1, Math.round(longest / BRUSH));

  const place = ({ clientX, clientY }) => {
    const box = svg.getBoundingClientRect();
    const room = tool === "brush" ? longest : 0; // strokes go on beside the photo
    const inside = (value, most) => Math.min(Math.max(Math.round(value), -room), most + room);
    return [inside(((clientX - box.left) / box.width) * W, W), inside(((clientY - box.top) / box.height) * H, H)];
  };

  function show() {
    if (shown !== shapes) {
      done.setAttribute(
        "d",
        shapes
          .filter(({ brush }) => !brush)
          .map(pathOf)
          .join(""),
      );
      patch(strokes, shapes.filter(({ brush }) => brush).map(strokeOf));
      shown = shapes;
    }
    const paints = tool === "brush";
    const begun = points && !paints && (tool === "rectangle" ? shapeOf(points, tool, 0) : points.flat());
    trace.setAttribute("d", begun ? pathOf(begun) : "");
    patch(stroke, points && paints && strokeOf({ brush: radius, points: points.flat() }));
    const middle = paints ? (cross ?? tip) : null;
    circle.style.display = middle ? "" : "none";
    for (const [key, value] of Object.entries(middle ? { cx: middle[0], cy: middle[1], r: radius } : {}))
      circle.setAttribute(key, value);
    const arm = longest / 40;
    mark.setAttribute(
      "d",
      cross ? `M${cross[0] - arm} ${cross[1]}h${2 * arm}M${cross[0]} ${cross[1] - arm}v${2 * arm}` : "",
    );
  }

  function become(next) {
    past.push(shapes);
    shapes = next;
    show();
    changed();
  }

  function press(point) {
    points = [point];
    show();
  }

  function move(point, apart = longest / SPACE) {
    const last = points.at(-1);
    if (tool === "brush" && points.length >= MOST_POINTS) {
      release();
      points = [last];
    }
    if (tool === "rectangle") points = [points[0], point];
    else if (Math.hypot(point[0] - last[0], point[1] - last[1]) >= apart) points.push(point);
    show();
  }

  function release() {
    const made = points && shapeOf(points, tool, longest / SPACE, radius);
    points = null;
    if (made) become([...shapes, made]);
    else show();
    return Boolean(made);
  }

  function drop() {
    const begun = Boolean(points);
    points = null;
    show();
    return begun;
  }

  svg.addEventListener("pointerdown", (event) => {
    if (event.button || !event.isPrimary) return;
    svg.setPointerCapture(event.pointerId);
    cross = null;
    tip = place(event);
    press(tip);
  });
  svg.addEventListener("pointermove", (event) => {
    if (!event.isPrimary) return;
    tip = place(event);
    if (points && !cross) move(tip);
    else if (tool === "brush") show();
  });
  svg.addEventListener("pointerleave", () => {
    tip = null;
    show();
  });
  svg.addEventListener("pointerup", (event) => {
    if (!points || cross || !event.isPrimary) return;
    move(place(event));
    release();
  });
  svg.addEventListener("pointercancel", drop);
  function resize(next) {
    radius = Math.min(Math.max(next, 1), Math.ceil(longest / MOST_RADIUS));
    show();
    changed();
  }

  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  svg.addEventListener("keydown", (event) => {
    const way = ways[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || (!way && event.key !== "Enter")) return;
    event.preventDefault();
    if (!cross) [cross, points] = [[Math.round(W / 2), Math.round(H / 2)], null];
    if (way) {
      const step = event.shiftKey ? 1 : Math.max(1, Math.round(longest / STEP));
      cross = [Math.min(Math.max(cross[0] + step * way[0], 0), W), Math.min(Math.max(cross[1] + step * way[1], 0), H)];
      if (points) move(cross, 0);
      announce(`${cross[0]}, ${cross[1]} px`);
    } else if (points) announce(release() ? `${count(shapes.length, "shape")} drawn` : "covers nothing");
    else {
      press(cross);
      announce("pressed; move, then press Enter again");
    }
    show();
  });
  show();
  const photo = h("img", { src, alt: "", width: W, height: H });
  const element = h("div", { class: "painted" }, photo, svg);
  element.style.setProperty("--ratio", W / H); // its size does not wait for the photo
  return {
    element,
    focus: () => svg.focus(),
    drop,
    get shapes() {
      return shapes;
    },
    get undoable() {
      return past.length > 0;
    },
    use: (next) => {
      drop();
      tool = next;
      show();
      changed();
    },
    resize,
    // [ and ] make the brush smaller and larger.
    press({ key, ctrlKey, metaKey, altKey }) {
      const way = { "[": -1, "]": 1 }[key];
      if (!way || tool !== "brush" || metaKey || (ctrlKey && !altKey)) return; // Alt Gr counts as both
      resize(way > 0 ? Math.max(radius + 1, Math.round(radius * FACTOR)) : Math.round(radius / FACTOR));
      announce(`radius ${radius} px`);
    },
    get tool() {
      return tool;
    },
    get radius() {
      return radius;
    },
    most: Math.ceil(longest / MOST_RADIUS),
    clear: () => become([]),
    // The shapes saved elsewhere come beneath those of each step that can be undone.
    load(base, others) {
      [shapes, ...past] = [shapes, ...past].map((own) => joined(base, own, others));
      show();
      changed();
    },
    undo() {
      drop();
      shapes = past.pop() ?? shapes;
      show();
      changed();
    },
  };
}

// Opens the dialog for a photo of a capture; saved(isMasked) is called each time a mask was stored. It follows what other
// tabs save: without changes here it shows their shapes, otherwise it offers them.
export async function drawMask(store, entry, photo, name, saved) {
  const address = at(entry, "mask");
  const read = () => get(`${address}?photo=${encodeURIComponent(photo)}`);
  const modified = () => store.entry(...entry.split("/"))?.modified;
  let seen = modified();
  const facts = await read();
  const line = errorLine();
  const said = h("p", { class: "quiet", role: "status" });
  const printed = h("div", {});
  let [base, version, stored] = [facts.shapes, facts.version, ""]; // what is saved, as far as what is drawn here knows
  let [newer, questions] = [null, 0]; // newer: the mask as it was saved elsewhere, with shapes that are not here
  const paper = sheet(`${at(entry, "thumbs", photo)}?side=1024`, name, facts, tell);
  const tools = ["rectangle", "outline", "brush"].map((tool, index) => {
    const pick = h("input", {
      type: "radio",
      name: "mask-tool",
      value: tool,
      checked: index === 0,
      onchange: () => paper.use(tool),
    });
    return h("label", { class: "check" }, pick, ` ${tool}`);
  });
  const size = h("input", {
    type: "range",
    min: 1,
    max: paper.most,
    "aria-label": "radius of the brush, px",
    title: "[ and ]",
    oninput: () => paper.resize(Number(size.value)),
  });
  const width = h("span", { class: "quiet" });
  const brush = h("span", { class: "row brush" }, size, width);
  const undo = button("Undo", () => paper.undo());
  const clear = button("Remove all", () => paper.clear(), {
    title: "The mask is then as it was before, once you save.",
  });
  const save = button("Save", () => attempt(save, line, keep).then(tell), { class: "primary" });
  const load = button(
    "Load the other shapes",
    () => {
      adopt(newer);
      paper.focus();
    },
    { hidden: true, title: "They come beneath yours." },
  );
  const close = button("Close", () => dialog.close());
  const own = facts.own ? " This photo has a mask of its own; it stays, and what you draw is added to it." : "";
  const dialog = h(
    "dialog",
    { class: "mask", "aria-labelledby": "mask-title" },
    heading(2, `Mask ${name}`, { id: "mask-title" }),
    h(
      "p",
      { class: "quiet" },
      `Draw around what does not belong to the scene. Trainings do not use those pixels.${own}`,
    ),
    h("fieldset", { class: "row" }, h("legend", { class: "aside" }, "shape"), tools, brush, undo, clear),
    paper.element,
    line,
    said,
    h("p", { class: "row" }, save, load, close),
    printed,
  );

  function tell() {
    const { shapes } = paper;
    const same = !isChanged();
    undo.disabled = !paper.undoable;
    brush.style.visibility = paper.tool === "brush" ? "" : "hidden"; // it keeps its place
    size.value = paper.radius;
    put(width, `${paper.radius} px`);
    clear.disabled = !shapes.length;
    save.disabled = same || Boolean(newer);
    load.hidden = !newer;
    const what = shapes.length ? count(shapes.length, "shape") : "Nothing is drawn";
    put(said, same && stored ? stored : `${what}${same ? "" : ", not saved"}.`);
  }

  const isChanged = () => JSON.stringify(paper.shapes) !== JSON.stringify(base);

  function adopt(found) {
    newer = null;
    put(line, "");
    stored = found.shapes.length
      ? `${count(found.shapes.length, "shape")}, saved in another tab.`
      : "Another tab has removed the shapes.";
    const before = base;
    [base, version] = [found.shapes, found.version];
    paper.load(before, found.shapes);
  }

  // Looks whether the mask was saved elsewhere since it was read here.
  async function look() {
    const asked = ++questions;
    const found = await read();
    if (asked !== questions) return; // it may be older than what was saved here meanwhile
    if (found.version !== version && !isChanged()) return adopt(found);
    newer = found.version === version ? null : found;
    if (newer) put(line, `${name}: another tab has saved this mask. Load its shapes beneath yours, then save.`);
    tell();
  }

  function follow() {
    if (modified() === seen) return;
    seen = modified();
    look().catch(() => {}); // saving reports what cannot be read
  }

  async function keep() {
    const answer = await post(address, { photo, shapes: paper.shapes, version }).catch(async (error) => {
      if (error.status === 409) await look();
      throw error;
    });
    questions += 1;
    [base, version] = [answer.shapes, answer.version];
    if (newer?.version === version) {
      // the library told of this version before the answer to saving came
      newer = null;
      put(line, "");
    }
    stored = answer.shapes.length
      ? "Saved. Trainings that begin from now on use it."
      : "Removed. The mask is as it was before.";
    patch(printed, want("p", { class: "quiet" }, "The same as a command"), commandLine(answer.command));
    saved(answer.shapes.length > 0);
  }

  dialog.addEventListener("cancel", (event) => paper.drop() && event.preventDefault()); // Escape gives up a begun shape first
  dialog.addEventListener("close", () => {
    store.removeEventListener("change", follow);
    dialog.remove();
  });
  dialog.addEventListener("keydown", (event) => {
    paper.press(event);
    if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z" || !paper.undoable) return;
    event.preventDefault();
    paper.undo();
  });
  document.body.append(dialog);
  tell();
  store.addEventListener("change", follow);
  follow(); // the mask may have been saved elsewhere while it was read
  dialog.showModal();
  paper.focus();
}

// The editor's panel: tools, their options, the list of operations.

import { element, icon, refill } from "./common.js";
import { EditFloaters, FLOATERS_PANEL } from "./edit_floaters.js";
import { FRONT_ROW } from "./edit_front.js";
import { numberFields } from "./edit_gizmo_panel.js";
import { EditHistogram, HISTOGRAM_PANEL } from "./edit_histogram.js";
import { LOOK_ROW } from "./edit_look.js";
import { NEAR_PANEL, proposedRadius } from "./edit_near.js";
import { POLYGON_ROW } from "./edit_polygon.js";
import { EditSearch } from "./edit_search.js";
import { length3, shortNumber } from "./edit_shapes.js";
import { POINTS_OF } from "./edit_tools.js";
import { TOUR_ROW } from "./edit_tour.js";
import { want } from "./patch.js";
import { plus } from "./vectors.js";

// Tools: name, what its button is called, its key and what it does, and its icon.
const TOOLS = [
  ["navigate", "navigate", "V: drags turn the view", "#icon-pointer"],
  ["rectangle", "rectangle", "T: select by a rectangle", "#icon-rectangle"],
  ["lasso", "lasso", "L: select by a freehand outline", "#icon-lasso"],
  ["polygon", "polygon", "Shift L: select by a polygon, corner after corner", "#icon-polygon"],
  ["brush", "brush", "B: select by painting; [ and ] change the size", "#icon-brush"],
  ["sphere", "sphere", "O: select by a sphere", "#icon-sphere"],
  ["box", "box", "X: select by a box, or crop to it", "#icon-box"],
  ["move", "move", "Shift V: move and turn the selected splats", "#icon-move"],
  ["color", "colour", "G: select by colour", "#icon-colour"],
  ["floor", "floor", "Z: turn the scene upright by three points of the floor", "#icon-floor"],
  ["scale", "scale", "C: set the scale by two points", "#icon-scale"],
  ["measure", "measure", "M: measure between two points", "#icon-measure"],
];

const toolButton = ([tool, name, title, icon]) =>
  `<button data-tool="${tool}" title="${title}"><svg class="icon" aria-hidden="true"><use href="${icon}"/></svg><span>${name}</span></button>`;

const EDIT_PANEL = `
<section id="edit" aria-label="editor">
<div id="edit-rail" role="toolbar" aria-label="tools" aria-orientation="vertical">
${TOOLS.map(toolButton).join("\n")}
</div>
<div id="edit-options">
<p id="edit-hint"></p>
<p class="row" data-for="rectangle lasso polygon brush sphere box color" role="group" aria-label="how selections combine">
<button data-how="replace" title="1: select only these">new</button>
<button data-how="add" title="2, or Shift: add to the selection">add</button>
<button data-how="subtract" title="3, or Ctrl: remove from the selection">subtract</button>
<button data-how="intersect" title="4, or Shift Ctrl: keep what both select">intersect</button>
</p>
${FRONT_ROW}${POLYGON_ROW}
<p class="row" data-for="brush"><label>size <input id="edit-radius" type="range" min="2" max="200" value="24"></label></p>
<p class="row" id="edit-center" data-for="sphere box" role="group" aria-label="centre"><span>centre</span></p>
<p class="row" data-for="sphere"><label>radius <input id="edit-sphere" type="number" step="any" min="0"></label></p>
<p class="row" data-for="box" id="edit-half" role="group" aria-label="half sizes"><span>half size</span></p>
<p class="row" data-for="sphere box"><button data-do="select-shape" title="Enter">select</button>
<button data-do="crop" data-for="box" title="Delete everything outside the box">crop to box</button></p>
<div data-for="move">
<p class="row numbers" id="edit-by" role="group" aria-label="moved by"><span>moved by</span></p>
<p class="row"><button data-do="move" title="Enter">move</button></p>
</div>
<div id="edit-handle" data-for="sphere box move"></div>
<div data-for="floor">
<p class="row" id="edit-cameras"><button data-do="level" title="Level the scene by its cameras, which are rarely rolled">level by the cameras</button></p>
<p id="edit-turned" role="status"></p>
<p class="row" role="group" aria-label="level by angles"><label>pitch <input id="edit-pitch" type="range" min="-45" max="45" step="0.1" value="0" title="Moves the horizon up and down"></label>
<label>roll <input id="edit-roll" type="range" min="-45" max="45" step="0.1" value="0" title="Turns the horizon"></label>
<span id="edit-tilts"></span>
<button data-do="level-angles" title="Turn the scene so that the line is its horizon">level by the line</button></p>
</div>
<p class="row" data-for="color"><label>colour <input id="edit-color" type="color" value="#808080"></label>
<label>tolerance <input id="edit-tolerance" type="range" min="1" max="128" value="24"></label>
<button data-do="select-color" title="Enter">select</button></p>
<p class="row" data-for="scale"><label>distance <input id="edit-length" type="number" step="any" min="0" value="1"></label>
<label>unit <select id="edit-unit"><option>m</option><option>cm</option><option>mm</option></select></label>
<button data-do="scale" title="Enter">set scale</button></p>
<p class="row" data-for="measure"><label>note <input id="edit-note" maxlength="200"></label>
<button data-do="measure" title="Enter">keep</button></p>
</div>
<div id="edit-column">
<div id="edit-history">
<p class="row">
<button data-do="undo" title="U or Ctrl Z: undo"><svg class="icon" aria-hidden="true"><use href="#icon-undo"/></svg><span>undo</span></button>
<button data-do="redo" title="Y or Ctrl Shift Z: redo"><svg class="icon" aria-hidden="true"><use href="#icon-redo"/></svg><span>redo</span></button>
<button data-do="save" title="Ctrl S: save the edits">save</button>
<button data-do="download" title="Download the edits as a file">download</button>
<button data-do="search" title="Ctrl K: find an action by its name">find</button>
<span id="edit-saved" role="status"></span>
</p>
<p id="edit-message" role="alert"></p>
</div>
<div id="edit-side">
<h2>Selection</h2>
<p id="edit-count" role="status"></p>
<p class="row" role="group" aria-label="selection">
<button data-do="all" title="0: select all">all</button>
<button data-do="none" title="N: select nothing">none</button>
<button data-do="invert" title="I: invert the selection">invert</button>
<button data-do="delete" title="Delete: delete the selected splats">delete</button>
<button data-do="hide" title="J: hide the selected splats">hide</button>
<button data-do="show" title="Shift J: show hidden splats again">show</button>
</p>
${LOOK_ROW}
${NEAR_PANEL}${HISTOGRAM_PANEL}
<details><summary>By numbers of opacity and size</summary>
<p class="row"><label>opacity from <input id="edit-opacity-low" type="number" min="0" max="1" step="0.01" value="0"></label>
<label>to <input id="edit-opacity-high" type="number" min="0" max="1" step="0.01" value="0.1"></label>
<button data-do="select-opacity">select</button></p>
<p class="row"><label>size from <input id="edit-size-low" type="number" min="0" step="any"></label>
<label>to <input id="edit-size-high" type="number" min="0" step="any"></label>
<button data-do="select-size">select</button></p>
</details>${FLOATERS_PANEL}
<details id="edit-list"><summary></summary><ol></ol></details>
<details id="edit-views"><summary></summary>
<p class="row"><button data-do="start" title="The exported page opens in this view">start here</button>
<label>name <input id="edit-name" maxlength="100"></label></p>
<label for="edit-text">text for the guided tour of the exported page (empty: no step)</label>
<textarea id="edit-text" maxlength="2000" rows="2"></textarea>
<p class="row"><button data-do="view" title="A view of the same name is replaced">keep view</button></p>
<ol></ol>${TOUR_ROW}</details>
<details id="edit-commands"><summary>Commands</summary><p>The saved edits, applied:</p><pre tabindex="0"></pre>
<p>Video of the camera path (preview: P):</p><pre tabindex="0"></pre></details>
</div>
</div>
</section>`;

const EDIT_HINTS = {
  navigate: "Drag turns the view. Choose a tool to select splats.",
  rectangle: "Drag a rectangle. Right drag and wheel still move the view; hold Space to turn it.",
  lasso: "Draw around what to select. Hold Space to turn the view.",
  polygon: "Click corner after corner. Enter, or a click on the first corner, closes the polygon.",
  brush: "Paint over what to select. Hold Space to turn the view.",
  sphere: "Drag from the centre on a surface, or move the handle; then select.",
  box: "Drag the handle, the dots on the sides, or a new box from its centre.",
  move: "Select splats first. Then drag the handle: arrows move, rings turn.",
  color: "Click a colour in the picture, then select.",
  floor: "Click three points of the floor, far apart, or lay the line on the horizon.",
  scale: "Click two points whose distance you know.",
  measure: "Click two points.",
};

// Keys by what they press in the panel.
const EDIT_KEYS = {
  v: "[data-tool=navigate]",
  t: "[data-tool=rectangle]",
  l: "[data-tool=lasso]",
  "Shift+l": "[data-tool=polygon]",
  b: "[data-tool=brush]",
  o: "[data-tool=sphere]",
  x: "[data-tool=box]",
  "Shift+v": "[data-tool=move]",
  g: "[data-tool=color]",
  z: "[data-tool=floor]",
  c: "[data-tool=scale]",
  m: "[data-tool=measure]",
  1: "[data-how=replace]",
  2: "[data-how=add]",
  3: "[data-how=subtract]",
  4: "[data-how=intersect]",
  5: "[data-do=front]",
  6: "[data-look=tint]",
  7: "[data-look=centres]",
  8: "[data-look=rings]",
  9: "[data-look=outline]",
  0: "[data-do=all]",
  n: "[data-do=none]",
  i: "[data-do=invert]",
  delete: "[data-do=delete]",
  backspace: "[data-do=delete]",
  j: "[data-do=hide]",
  "Shift+j": "[data-do=show]",
  ".": "[data-do=grow]",
  ",": "[data-do=shrink]",
  u: "[data-do=undo]",
  y: "[data-do=redo]",
};

// What Enter applies, by tool.
const EDIT_APPLIES = {
  sphere: "select-shape",
  box: "select-shape",
  move: "move",
  color: "select-color",
  scale: "scale",
  measure: "measure",
};

export class EditPanel {
  constructor(editor) {
    this.editor = editor;
    document.body.insertAdjacentHTML("beforeend", EDIT_PANEL);
    this.root = element("edit");
    this.listKeys();
    this.histogram = new EditHistogram(editor);
    this.floaters = new EditFloaters(editor, this);
    this.search = new EditSearch(this.root);
    element("edit-near").value = proposedRadius(editor.values);
    this.numbers = { center: this.addNumbers("edit-center"), half: this.addNumbers("edit-half") };
    this.root.addEventListener("click", (event) => this.click(event.target.closest("button")));
    this.root.addEventListener("input", (event) => this.input(event.target));
    // what is typed into a field is no command of the page
    this.root.addEventListener("keydown", (event) => this.typed(event));
    const [convert, render] = this.root.querySelectorAll("pre");
    const { commands } = editor.scene;
    [convert.textContent, render.textContent] = [commands?.convert ?? "", commands?.render ?? ""];
    element("edit-commands").hidden = !commands;
    this.button("save").hidden = !editor.save;
  }

  button(name) {
    return this.root.querySelector(`[data-do=${name}]`);
  }

  // Adds the editor's keys to the page's help, from the titles of its buttons.
  listKeys() {
    const rows = [...this.root.querySelectorAll("[title]")].map(({ title }) => title.match(/^([^:]+): (.+)$/));
    const more = [
      ["Arrows", "move a cross in the picture; by single pixels with Shift"],
      ["Enter", "press at the cross, press again to release; then apply"],
      ["Space", "held: drags turn the view"],
      ["Escape", "drop what is drawn, then leave the tool"],
      ["[ ]", "size of the brush"],
      ["Shift X", "choose a part of the handle, which the arrows then move; finer with Shift"],
    ];
    const heading = document.createElement("h2");
    heading.textContent = "Editor";
    const table = document.createElement("table");
    heading.className = table.className = "mouse"; // not on a device that has only a touch screen
    for (const [key, what] of [...rows.filter(Boolean).map((row) => row.slice(1)), ...more]) {
      const row = table.insertRow();
      row.insertCell().textContent = key;
      row.insertCell().textContent = what;
    }
    element("help").append(heading, table);
  }

  addNumbers(id) {
    return numberFields(id);
  }

  click(button) {
    const { editor } = this;
    if (!button) return;
    const { tool, how, look } = button.dataset;
    if (tool) editor.tools.choose(tool);
    else if (how) editor.chooseHow(how);
    else if (look) editor.look.choose(look);
    else if (button.dataset.do) this.act(button.dataset.do);
    // a disabled button loses the focus
    if (button.disabled && document.activeElement !== editor.viewer.canvas)
      [this.button("undo"), this.button("redo"), this.button("all")].find((one) => !one.disabled).focus();
  }

  act(name) {
    const { editor } = this;
    const values = (id) => Number(element(id).value);
    const actions = {
      all: () => editor.perform({ op: "select", how: "replace", by: "all" }),
      none: () => editor.perform({ op: "deselect" }),
      invert: () => editor.perform({ op: "invert" }),
      delete: () => editor.perform({ op: "delete" }),
      hide: () => editor.perform({ op: "hide" }),
      show: () => editor.perform({ op: "show" }),
      grow: () => editor.near("grow", values("edit-near")),
      shrink: () => editor.near("shrink", values("edit-near")),
      propose: () => this.floaters.propose(),
      "stop-proposing": () => this.floaters.stop(),
      "select-range": () => this.histogram.select(),
      front: () => editor.chooseFront(!editor.frontOnly),
      "close-polygon": () => editor.tools.polygon.close(editor.how),
      "corner-back": () => editor.tools.polygon.back(),
      undo: () => editor.undo(),
      redo: () => editor.redo(),
      save: () => editor.store(),
      download: () => editor.download(),
      crop: () => editor.crop(),
      move: () => editor.mover.perform(),
      level: () => editor.leveller.level(),
      "level-angles": () => editor.leveller.levelByAngles(),
      start: () => editor.startHere(),
      view: () => editor.keepView(element("edit-name").value.trim(), element("edit-text").value.trim()),
      tour: () => editor.tour.guide.toggle(),
      search: () => this.search.open(),
      grid: () => editor.chooseGrid(!editor.grid),
      scale: () => editor.setScale(values("edit-length"), element("edit-unit").value),
      measure: () => editor.keepMeasure(element("edit-note").value.trim()),
      "select-shape": () => editor.selectShape(),
      "select-color": () => editor.selectColor(element("edit-color").value, values("edit-tolerance")),
      "select-opacity": () => editor.selectOpacity(values("edit-opacity-low"), values("edit-opacity-high")),
      "select-size": () => editor.selectSize(element("edit-size-low").value, element("edit-size-high").value),
    };
    actions[name]();
  }

  // Whether Enter applies something chosen before.
  get ready() {
    const { tool, shape, apart } = this.editor.tools;
    return Boolean(
      { sphere: shape, box: shape, move: this.editor.mover.moved, color: true, scale: apart, measure: apart }[tool],
    );
  }

  apply() {
    const name = EDIT_APPLIES[this.editor.tools.tool];
    if (name && this.ready) this.act(name);
  }

  // Presses the button of a key; returns whether it has one.
  pressKey(key) {
    if (key === "[" || key === "]") {
      element("edit-radius").value = this.editor.radius * (key === "]" ? 1.2 : 1 / 1.2);
      this.input(element("edit-radius"));
      return true;
    }
    if (key === "Shift+x") return this.editor.tools.gizmo.chooseNext();
    const button = EDIT_KEYS[key] && this.root.querySelector(EDIT_KEYS[key]);
    button?.click();
    return Boolean(button);
  }

  typed(event) {
    if (!event.target.matches("input, select, textarea")) return;
    event.stopPropagation();
    if (event.key === "Escape") event.target.blur();
    if (event.key === "Enter" && event.target.matches("input:not([type=color]), select")) this.apply();
  }

  // Takes numbers of the shape that were typed.
  input(field) {
    const { editor } = this;
    const { shape } = editor.tools;
    if (field.id === "edit-radius") editor.radius = Number(field.value);
    const value = Number(field.value);
    if (!shape || field.value === "" || !Number.isFinite(value)) return editor.redraw();
    for (const name of ["center", "half"]) {
      const index = this.numbers[name].indexOf(field);
      const allowed = name === "center" ? Math.abs(value) < 1e30 : value > 0;
      if (index >= 0 && allowed) shape[name] = shape[name].map((old, i) => (i === index ? value : old));
    }
    if (field.id === "edit-sphere" && value > 0) shape.radius = value;
    return editor.redraw();
  }

  // Shows the tool, the counts and the operations.
  update() {
    const { tools, how, history } = this.editor;
    for (const button of this.root.querySelectorAll("[data-tool]")) {
      button.setAttribute("aria-pressed", button.dataset.tool === tools.tool);
    }
    for (const button of this.root.querySelectorAll("[data-how]")) {
      button.setAttribute("aria-pressed", button.dataset.how === how);
    }
    for (const part of this.root.querySelectorAll("[data-for]")) {
      part.hidden = !part.dataset.for.split(" ").includes(tools.tool);
    }
    element("edit-hint").textContent = this.hint();
    this.showCounts(history.counts());
    this.button("undo").disabled = !history.done.length;
    this.button("redo").disabled = !history.undone.length;
    this.button("grid").setAttribute("aria-pressed", Boolean(this.editor.grid));
    this.button("front").setAttribute("aria-pressed", this.editor.frontOnly);
    this.button("close-polygon").disabled = !tools.polygon.canClose;
    this.button("corner-back").disabled = !tools.polygon.corners.length;
    this.button("select-shape").disabled = this.button("crop").disabled = !tools.shape;
    this.button("scale").disabled = this.button("measure").disabled = tools.apart === null;
    this.showShape();
  }

  hint() {
    const { tools, lengthText } = this.editor;
    if (tools.apart !== null) return `Distance: ${lengthText(tools.apart)}`;
    const left = (POINTS_OF[tools.tool] ?? 0) - tools.points.length;
    return tools.points.length && left > 0 ? `${left} more point${left > 1 ? "s" : ""}.` : EDIT_HINTS[tools.tool];
  }

  showCounts({ all, selected, hidden, deleted }) {
    const number = (value) => value.toLocaleString("en");
    const parts = [
      `${number(selected)} selected`,
      hidden && `${number(hidden)} hidden`,
      `${number(all - hidden - deleted)} of ${number(all)} left`,
    ];
    element("edit-count").textContent = parts.filter(Boolean).join(" · ");
    for (const name of ["delete", "hide", "grow", "shrink"]) this.button(name).disabled = !selected;
    this.button("show").disabled = !hidden;
  }

  showShape() {
    const { shape } = this.editor.tools;
    const fill = (input, value) => {
      if (input !== document.activeElement) input.value = value === undefined ? "" : Number(value.toPrecision(4));
    };
    this.numbers.center.forEach((input, i) => fill(input, shape?.center[i]));
    this.numbers.half.forEach((input, i) => fill(input, shape?.half?.[i]));
    fill(element("edit-sphere"), shape?.radius);
    this.editor.tools.gizmo.panel.update();
    this.editor.mover.update();
  }

  fill(id, items) {
    refill(element(id).querySelector("ol"), items, element(id).querySelector("summary"));
  }

  // Lists of views and operations; only after a change of them.
  list() {
    const { history, editor } = { history: this.editor.history, editor: this.editor };
    const views = history.views();
    const button = (shown, label, onclick, more = {}) =>
      want("button", { "aria-label": label || null, ...more, onclick }, shown);
    const row = (...parts) => want("li", {}, ...parts);
    const names = [...views.named.keys()];
    const rows = [...views.named.values()].map((view) =>
      row(
        button(view.text ? `${view.name} · tour` : view.name, `go to ${view.name}`, () => this.show(view)),
        ...editor.tour.buttons(view.name, names, button),
        button(icon("#icon-close"), `remove ${view.name}`, () =>
          editor.perform({ op: "remove_view", name: view.name }),
        ),
      ),
    );
    if (views.start) rows.unshift(row(button("start", "go to the start view", () => editor.goTo(views.start))));
    this.fill("edit-views", rows);
    editor.tour.follow(views);
    element("edit-views").querySelector("summary").textContent = `Views (${rows.length})`;
    const operations = [...history.done, ...[...history.undone].reverse()];
    const step = (at, text) => {
      const current = { "aria-current": String(at === history.done.length) };
      const undone = at > history.done.length ? "undone" : null;
      return want(
        "li",
        { class: undone },
        button(text, "", () => editor.goToStep(at), current),
      );
    };
    const items = operations.map((operation, i) => step(i + 1, describeOperation(operation)));
    if (operations.length) items.unshift(step(0, "as opened"));
    this.fill("edit-list", items);
    element("edit-list").querySelector("summary").textContent = `History (${history.done.length})`;
  }

  // Goes to a named view, whose name and text can then be changed.
  show(view) {
    element("edit-name").value = view.name;
    element("edit-text").value = view.text ?? "";
    this.editor.goTo(view);
  }

  showColor(color) {
    element("edit-color").value = color;
  }

  saved(text) {
    element("edit-saved").textContent = text;
  }
}

function describeOperation(operation) {
  const { op, how, by, name, note } = operation;
  const verbs = { replace: "select", add: "add", subtract: "subtract", intersect: "intersect" };
  if (op === "grow" || op === "shrink") return `${op} by ${shortNumber(operation.radius)}`;
  if (by === "list") return `${verbs[how]}: ${operation.reason}`;
  if (op === "select") return by === "all" ? "select all" : `${verbs[how]} by ${by === "color" ? "colour" : by}`;
  if (op === "scale") {
    const apart = length3(plus(...operation.points, -1));
    return `scale: ${shortNumber(apart)} units = ${operation.length} ${operation.unit}`;
  }
  const texts = {
    deselect: "select none",
    invert: "invert",
    crop: "crop to box",
    move: "move the selection",
    show: "show hidden",
    upright: "turn upright",
    start: "start view",
    view: `view ${name}`,
    order_views: "order of the views",
    remove_view: `remove view ${name}`,
    path: operation.path ? `camera path of ${operation.path.keyframes.length} views` : "no camera path",
    measure: `distance${note ? `: ${note}` : ""}`,
  };
  return texts[op] ?? op;
}

// The editor: a list of operations on a scene, its state, and everything that the tools and the panel can do.

import { element } from "./common.js";
import { ViewCube } from "./edit_cube.js";
import { FlagTexture } from "./edit_draw.js";
import { SELECTED } from "./edit_flags.js";
import { Leveller } from "./edit_level.js";
import { EditLook } from "./edit_look.js";
import { movedTogether, Mover } from "./edit_move.js";
import { Overlay } from "./edit_overlay.js";
import { EditPanel } from "./edit_panel.js";
import { splatsAt } from "./edit_pixel.js";
import { boxLines, length3, levelled, normalOf, shortNumber, storedView } from "./edit_shapes.js";
import { EditHistory } from "./edit_state.js";
import { EditTools } from "./edit_tools.js";
import { EditTour } from "./edit_tour.js";
import { Keyframes, readKeyframe } from "./keyframes.js";
import { cross, dot, plus } from "./vectors.js";

const EDIT_FORMAT = { format: "gsplat_edu edits", version: 1 };
const [SH_C0, SH_HALF] = [0.28209479177387814, 0.5]; // colour = SH_C0 sh0 + SH_HALF
const LEAST_SHARE = 1e-6; // opacities at or beyond this from 0 and 1 leave the range open

// Starts the editor above a viewer.
//
// viewer: the page's Viewer; it must draw a whole scene, with shaders that were made for editing.
// scene: {count, sha256, origin} as an edits file has them, file (a name for downloads), commands ({convert, render},
//   or none), floaters (where the server proposes splats to delete, or none), values: {count, means, log_scales, logits, sh0}, float32 arrays with the scene's exact parameters.
// edits: the parsed content of an edits file of this scene, or null.
// save: async (text) => anything, which stores the content of an edits file or throws an Error with one line; null for
//   no button.
export function startEditor({ viewer, scene, edits, save }) {
  return new Editor(viewer, scene, edits?.operations ?? [], save);
}

class Editor {
  constructor(viewer, scene, operations, save) {
    Object.assign(this, { viewer, scene, values: scene.values });
    this.save = save;
    this.storing = null; // the save that is on its way
    this.overlayAsked = 0;
    this.how = "replace";
    this.frontOnly = false; // whether selections in the picture leave out what lies behind the visible surface
    this.radius = 24; // of the brush, CSS pixels
    this.history = new EditHistory(scene.values, operations);
    this.stored = this.text();
    this.lengthText = (length) => this.textOf(length);
    this.texture = viewer.renderer.flags ??= new FlagTexture(viewer.renderer);
    this.overlay = new Overlay(viewer);
    const { start: camera, pivot, up } = viewer.view;
    this.opened = { camera, pivot, up, path: viewer.keyframes.path, text: "" };
    this.lastViews = "";
    this.panel = new EditPanel(this);
    this.mover = new Mover(this);
    this.leveller = new Leveller(this);
    this.tools = new EditTools(this);
    this.look = new EditLook(this);
    this.tour = new EditTour(this);
    this.cube = new ViewCube(viewer);
    this.grid = null; // its lines, while it is shown
    this.follow();
    this.stateChanged();
    document.body.classList.add("editing", "glass");
    addEventListener("beforeunload", (event) => {
      if (this.text() !== this.stored) event.preventDefault();
    });
  }

  // Draws the overlay after each picture, and hears of changes of the camera path.
  follow() {
    const { viewer } = this;
    const put = viewer.put.bind(viewer);
    viewer.put = (camera) => {
      put(camera);
      this.look.draw(camera);
      this.drawOverlay(camera);
    };
    viewer.depthAt = (camera, column, row) => this.tools.depthAt(camera, column, row);
    const { actions } = viewer.keyframes;
    const changed = actions.pathChanged;
    actions.pathChanged = () => {
      changed();
      this.pathChanged();
    };
  }

  drawOverlay(camera) {
    this.overlay.begin(camera);
    this.cube.follow(camera);
    if (this.grid) this.overlay.lines(this.grid, "#fff9");
    for (const { points, note } of this.history.views().measures) {
      this.overlay.lines([points], "#7fd4ff");
      this.overlay.dot(points[0], "", "#7fd4ff");
      this.overlay.dot(points[1], `${this.textOf(length3(plus(...points, -1)))}${note ? ` ${note}` : ""}`, "#7fd4ff");
    }
    const crop = this.history.done.findLast(({ op }) => op === "crop");
    if (crop) this.overlay.lines(boxLines(crop), "#9fe8a0", true);
    if (this.tools.tool === "floor") this.leveller.draw(this.overlay, camera);
    this.tools.draw(this.overlay);
    this.panel.histogram.viewed();
  }

  // Draws the overlay again. The splats below are not drawn again, which takes much longer without a graphics processor.
  redraw() {
    this.overlayAsked ||= requestAnimationFrame(() => {
      this.overlayAsked = 0;
      this.drawOverlay(this.viewer.camera());
    });
  }

  // The tool, or what it has drawn, has changed.
  changed() {
    this.panel.update();
    this.redraw();
  }

  say(text) {
    element("edit-message").textContent = text;
  }

  chooseHow(how) {
    this.how = how;
    this.changed();
  }

  chooseFront(frontOnly) {
    this.frontOnly = frontOnly;
    this.changed();
  }

  chooseGrid(isShown) {
    this.grid = isShown ? this.cube.grid(this.values) : null;
    this.changed();
  }

  find() {
    this.panel.search.open();
  }

  // Applies an operation and adds it to the list. An error of ours leaves the list as it was.
  perform(operation) {
    try {
      this.history.perform(operation);
    } catch (error) {
      this.say(error.message);
      return;
    }
    this.say("");
    this.stateChanged();
  }

  undo() {
    if (this.history.undo()) this.stateChanged();
  }

  redo() {
    if (this.history.redo()) this.stateChanged();
  }

  // Undoes or repeats operations until a number of them is done.
  goToStep(count) {
    while (this.history.done.length > count && this.history.undo());
    while (this.history.done.length < count && this.history.redo());
    this.stateChanged();
  }

  stateChanged() {
    this.texture.write(this.history.flags);
    this.together = this.viewer.meshes ? movedTogether(this.values, this.history.flags) : null;
    this.mover.follow();
    this.mover.placeMesh();
    this.leveller.reset();
    this.look.changed();
    this.applyViews(this.history.views());
    this.panel.list();
    this.panel.histogram.changed();
    this.panel.saved(this.text() === this.stored ? "" : "not saved");
    this.changed();
    this.viewer.refresh();
  }

  // Brings the page's up direction, start view and path to where the operations have them.
  applyViews({ upright, start, path }) {
    const key = JSON.stringify([upright, start, path]);
    if (key === this.lastViews) return;
    this.lastViews = key;
    const { view, keyframes } = this.viewer;
    const before = view.up;
    view.up = upright ? normalOf(upright.points) : this.opened.up;
    const camera = start ? keyframes.camera(readKeyframe(start)) : this.opened.camera;
    view.start = upright ? levelled(camera, view.up) : camera;
    view.pivot = start ? start.pivot : this.opened.pivot;
    if (before.some((x, i) => x !== view.up[i])) view.camera = levelled(view.camera, view.up);
    if (this.grid) this.grid = this.cube.grid(this.values);
    const wanted = path === undefined ? this.opened.path : pathOf(path);
    if (JSON.stringify(storedPath(wanted)) !== JSON.stringify(storedPath(keyframes.path))) {
      keyframes.path = wanted;
      keyframes.list();
    }
  }

  // The user has saved or removed a view of the camera path.
  pathChanged() {
    const { path } = this.viewer.keyframes;
    if (path.keyframes.length > 1) this.perform({ op: "path", path: storedPath(path) });
    else if (this.history.views().path) {
      this.lastViews = JSON.stringify([this.history.views().upright, this.history.views().start, null]); // keeps the last view
      this.perform({ op: "path", path: null });
    }
  }

  selectShape() {
    const { tool, shape } = this.tools;
    if (!shape) return;
    this.perform({ op: "select", how: this.how, by: tool, ...shape });
  }

  crop() {
    if (this.tools.shape) this.perform({ op: "crop", ...this.tools.shape });
  }

  // Selects colours within a tolerance (in steps of 1/255) of a hexadecimal one.
  selectColor(color, tolerance) {
    const raw = (step) => (step / 255 - SH_HALF) / SH_C0;
    const steps = [1, 3, 5].map((i) => parseInt(color.slice(i, i + 2), 16));
    // whatever is beyond white or black counts as white or black
    const low = steps.map((step) => (step - tolerance <= 0 ? -1e6 : raw(step - tolerance)));
    const high = steps.map((step) => (step + tolerance >= 255 ? 1e6 : raw(step + tolerance)));
    this.perform({ op: "select", how: this.how, by: "color", low, high });
  }

  selectOpacity(low, high) {
    const logit = (share) => Math.log(share / (1 - share));
    this.selectRange(
      "opacity",
      low > LEAST_SHARE ? logit(Math.min(low, 1 - LEAST_SHARE)) : null,
      high < 1 - LEAST_SHARE ? logit(Math.max(high, LEAST_SHARE)) : null,
    );
  }

  // Selects by the largest standard deviation, as texts of world units; empty for no limit.
  selectSize(low, high) {
    const log = (text) => (Number(text) > 0 ? Math.log(Number(text)) : null);
    this.selectRange("size", log(low), log(high));
  }

  // Selects by the distance from a point; null for no limit.
  selectDistance(center, low, high) {
    this.selectRange("distance", low, high, { center });
  }

  // Grows or shrinks the selection by a radius, in world units.
  near(op, radius) {
    if (!(radius >= 1e-30 && radius <= 1e30)) return this.say("Give a radius above 0.");
    return this.perform({ op, radius });
  }

  selectRange(by, low, high, more = {}) {
    if (low === null && high === null) return this.say("Give a lower or an upper limit.");
    if (low !== null && high !== null && low > high) return this.say("The lower limit is above the upper one.");
    const range = { ...(low === null ? {} : { low }), ...(high === null ? {} : { high }) };
    return this.perform({ op: "select", how: this.how, by, ...more, ...range });
  }

  // Turns the scene upright by three points of the floor, of which the eye is above; returns whether they span a plane.
  level(points, eye) {
    const sides = [plus(points[1], points[0], -1), plus(points[2], points[0], -1)];
    const sine = length3(cross(...sides)) / (length3(sides[0]) * length3(sides[1]));
    if (!(sine > 1e-3)) {
      this.say("These points lie on one line; choose three that span the floor.");
      this.tools.points = [];
      return false;
    }
    const above = dot(cross(...sides), plus(eye, points[0], -1)) > 0;
    this.perform({ op: "upright", points: above ? points : [points[0], points[2], points[1]] });
    return true;
  }

  setScale(length, unit) {
    const { points, apart } = this.tools;
    if (!(length > 0) || !(apart > 0)) return this.say("Give a distance above 0, and two points that are apart.");
    this.perform({ op: "scale", points, length, unit });
    return this.tools.cancel();
  }

  keepMeasure(note) {
    const { points, apart } = this.tools;
    if (!(apart > 0)) return this.say("Choose two points that are apart.");
    this.perform({ op: "measure", points, note });
    return this.tools.cancel();
  }

  startHere() {
    const { camera, focus } = this.viewer.view;
    this.perform({ op: "start", ...storedView(camera), pivot: focus });
  }

  keepView(name, text) {
    if (!name) return this.say("Give the view a name.");
    return this.perform({ op: "view", name, ...storedView(this.viewer.view.camera), ...(text ? { text } : {}) });
  }

  goTo(view) {
    const { keyframes } = this.viewer;
    keyframes.actions.goToView(keyframes.camera(readKeyframe(view)));
  }

  // A length with its unit, after the scale of the operations.
  textOf(length) {
    const { scale } = this.history.views();
    if (!scale) return `${shortNumber(length)} units`;
    return `${shortNumber((length * scale.length) / length3(plus(...scale.points, -1)))} ${scale.unit}`;
  }

  // The colour of a pixel without the highlight, as hexadecimal text. Only that pixel is drawn, from the splats that may
  // cover it.
  pictureColor(camera, column, row) {
    const { renderer, settings, sorter, facts } = this.viewer;
    const { gl, count } = renderer;
    this.texture.write(this.history.flags.map((flag) => (flag === SELECTED ? 0 : flag)));
    renderer.setOrder(splatsAt(this.values, this.history.flags, camera, column, row, facts.near));
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(column, camera.H - 1 - row, 1, 1);
    this.look.plainly(() => renderer.draw(camera, settings));
    const pixel = new Float32Array(4);
    gl.readPixels(column, camera.H - 1 - row, 1, 1, gl.RGBA, gl.FLOAT, pixel);
    gl.disable(gl.SCISSOR_TEST);
    if (!sorter.running) renderer.setOrder(new Uint32Array(sorter.order, 0, count)); // otherwise a new order comes
    this.texture.write(this.history.flags);
    const byte = (value) =>
      Math.round(255 * Math.min(Math.max(value, 0), 1))
        .toString(16)
        .padStart(2, "0");
    return `#${[...pixel.subarray(0, 3)].map(byte).join("")}`;
  }

  // The content of the edits file: an operation per line.
  text() {
    const { count, sha256, origin } = this.scene;
    const head = { ...EDIT_FORMAT, scene: { count, sha256, origin } };
    const lines = Object.entries(head).map(([key, value]) => ` ${JSON.stringify(key)}: ${JSON.stringify(value)},\n`);
    const operations = this.history.done.map((operation) => `\n  ${JSON.stringify(operation)}`);
    return `{\n${lines.join("")} "operations": [${operations.join(",")}${operations.length ? "\n " : ""}]\n}\n`;
  }

  // Saves what there is now. A second save waits for the first one, whose answer has the version that it replaces.
  async store() {
    if (!this.save) return this.download();
    const again = () => (this.text() === this.stored ? undefined : this.storeNow());
    const mine = (this.storing = this.storing ? this.storing.then(again) : this.storeNow());
    await mine;
    if (this.storing === mine) this.storing = null;
    return undefined;
  }

  async storeNow() {
    const text = this.text();
    this.panel.saved("saving ...");
    try {
      await this.save(text);
      this.stored = text;
      this.say("");
    } catch (error) {
      this.say(error.message);
    }
    this.panel.saved(this.text() === this.stored ? "saved" : "not saved");
  }

  download() {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([this.text()], { type: "application/json" }));
    link.download = this.scene.file;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000); // the browser may still be reading
  }
}

// A camera path as an edits file stores it: that of `render --path`, in the coordinates of the opened scene.
function storedPath(path) {
  return Keyframes.prototype.document.call({ path, facts: { origin: [0, 0, 0] } });
}

function pathOf(stored) {
  if (!stored) return { loop: false, duration: null, ease: null, keyframes: [] };
  const { loop, duration = null, ease = null, keyframes } = stored;
  return { loop, duration, ease, keyframes: keyframes.map(readKeyframe) };
}

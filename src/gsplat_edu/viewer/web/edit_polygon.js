// The polygon tool: corner after corner by clicks, taps or the keyboard's cross; it selects as a lasso does.

import { LEAST_DRAG, MOST_STROKE, pictureOf } from "./edit_shapes.js";

const CLOSES = 10; // CSS pixels from the first corner within which a click closes the polygon
const CLOSES_FINGER = 22; // the same for a finger
const LEAST_CORNERS = 3;

export const POLYGON_ROW = `
<p class="row" data-for="polygon"><button data-do="close-polygon" title="Enter">close</button>
<button data-do="corner-back" title="Backspace: take the last corner of a polygon back">take back</button></p>`;

export class EditPolygon {
  constructor(tools) {
    Object.assign(this, { tools, corners: [], camera: null });
  }

  get canClose() {
    return this.corners.length >= LEAST_CORNERS;
  }

  // Adds a corner, or closes at the first one, or by a second click at the last one.
  click({ camera, at }, how) {
    const { corners } = this;
    const apart = (corner) => (corner ? Math.hypot(corner.x - at.x, corner.y - at.y) : Infinity);
    const again = apart(corners.at(-1)) < LEAST_DRAG;
    if (
      this.canClose &&
      (again || apart(corners[0]) <= (matchMedia("(pointer: coarse)").matches ? CLOSES_FINGER : CLOSES))
    ) {
      this.close(how);
    } else if (!again && corners.length < MOST_STROKE) {
      if (!corners.length) this.camera = camera;
      corners.push(at);
      this.tools.editor.say("");
    }
  }

  // Selects what the polygon holds.
  close(how) {
    if (!this.canClose) return;
    const points = this.corners.map(({ u, v }) => [u, v]);
    const { camera } = this;
    this.corners = [];
    this.tools.viewer.canvas.focus(); // the button becomes disabled
    this.tools.select(how, { by: "lasso", camera: pictureOf(camera), points }, camera);
    this.tools.editor.changed();
  }

  // Takes the last corner back; returns whether this tool is chosen.
  back() {
    if (this.tools.tool !== "polygon") return false;
    this.corners.pop();
    if (!this.corners.length) this.tools.viewer.canvas.focus(); // the button becomes disabled
    this.tools.editor.changed();
    return true;
  }

  // Sets a corner at the keyboard's cross, or closes if the cross has not moved since the last corner; returns whether
  // this tool is chosen.
  enter(event) {
    const { tools } = this;
    if (tools.tool !== "polygon" || tools.stroke) return false;
    const how = tools.howOf(event);
    if (tools.cursor && (tools.cursorMoved || !this.canClose)) {
      tools.press("keyboard", tools.cursor.x, tools.cursor.y);
      tools.cursorMoved = false;
      tools.release(how);
    } else this.close(how);
    return true;
  }

  // Forgets the corners; returns whether there were any.
  drop() {
    const some = this.corners.length > 0;
    this.corners = [];
    return some;
  }

  draw(overlay) {
    const { corners, tools } = this;
    if (!corners.length) return;
    if (JSON.stringify(pictureOf(overlay.camera)) !== JSON.stringify(pictureOf(this.camera))) {
      this.drop();
      tools.editor.say("The view has moved; set the corners again.");
      tools.editor.panel.update();
      return;
    }
    const { stroke, cursor, hover } = tools;
    const next = stroke?.at ?? (cursor ? tools.pointOf(overlay.camera, cursor.x, cursor.y) : hover);
    overlay.polyline(next ? [...corners, next] : corners, corners.length > 1);
    for (const [i, corner] of corners.entries()) overlay.circle(corner, (i ? 3 : 6) * tools.perPixel, "#fff");
  }
}

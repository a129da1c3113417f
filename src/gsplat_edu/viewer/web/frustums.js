// The capture's cameras over the scene: outlines of what they see, at a fixed depth. Those of held-out photos are dashed.

import { pointAt } from "./camera.js";
import { element } from "./common.js";
import { dot, plus } from "./vectors.js";

const OUTLINE_SHARE = 0.06; // depth of an outline, of the distance from the start view to the pivot
const OUTLINE_NEAR = 1e-3; // of that depth: lines are cut this close to the eye
const OUTLINE_COLORS = [
  ["#000a", 3.5],
  ["#58c7ff", 1.5],
]; // each line is drawn in all of them, widths in px
const HELD_OUT = "#ffb54a";

export class Frustums {
  constructor(viewer) {
    const { cameras, start } = viewer.facts;
    this.list = cameras.filter(({ saved }) => !saved);
    this.depth = OUTLINE_SHARE * Math.hypot(...plus(start.pivot, start.camera.eye, -1));
    this.canvas = element("frustums");
    this.box = element("show-frustums");
    this.box.addEventListener("change", () => {
      this.canvas.hidden = !this.box.checked;
      viewer.repaint();
    });
    element("frustums-held-out").hidden = !this.list.some(({ held_out: held }) => held);
  }

  // The ends of a camera's lines in the world: from its centre to the corners of its image, and around the image.
  lines(camera) {
    const { W, H } = camera;
    const corners = [
      [-0.5, -0.5],
      [W - 0.5, -0.5],
      [W - 0.5, H - 0.5],
      [-0.5, H - 0.5],
    ].map(([u, v]) => pointAt(camera, u, v, this.depth));
    return corners.flatMap((corner, i) => [
      [camera.eye, corner],
      [corner, corners[(i + 1) % 4]],
    ]);
  }

  // A line as a camera sees it: [u, v, u, v] in px, cut in front of the eye; null behind it.
  seen([a, b], { R, eye, fx, fy, cx, cy }) {
    const near = OUTLINE_NEAR * this.depth;
    const [p, q] = [a, b].map((point) => R.map((row) => dot(row, plus(point, eye, -1))));
    if (p[2] <= near && q[2] <= near) return null;
    const cut = (from, to) =>
      from[2] > near ? from : plus(from, plus(to, from, -1), (near - from[2]) / (to[2] - from[2]));
    return [cut(p, q), cut(q, p)].flatMap(([x, y, z]) => [(fx * x) / z + cx, (fy * y) / z + cy]);
  }

  // Draws the outlines over the picture of a camera; its own is left out.
  place(shown) {
    if (this.canvas.hidden) return;
    const { canvas } = this;
    const context = canvas.getContext("2d");
    [canvas.width, canvas.height] = [shown.W, shown.H];
    const paths = [false, true].map((held) => {
      const path = new Path2D();
      for (const camera of this.list) {
        if (Boolean(camera.held_out) !== held || Math.hypot(...plus(camera.eye, shown.eye, -1)) < 0.1 * this.depth)
          continue;
        for (const line of this.lines(camera)) {
          const ends = this.seen(line, shown);
          if (!ends) continue;
          path.moveTo(ends[0] + 0.5, ends[1] + 0.5); // the centre of pixel (0, 0) is half a pixel inside the corner
          path.lineTo(ends[2] + 0.5, ends[3] + 0.5);
        }
      }
      return path;
    });
    const dense = devicePixelRatio || 1;
    for (const [color, width] of OUTLINE_COLORS) {
      paths.forEach((path, held) => {
        context.lineWidth = width * dense;
        context.strokeStyle = held && color !== OUTLINE_COLORS[0][0] ? HELD_OUT : color;
        context.setLineDash(held ? [6 * dense, 4 * dense] : []);
        context.stroke(path);
      });
    }
  }
}

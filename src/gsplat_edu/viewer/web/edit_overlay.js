// Lines above the picture of a page: a canvas of their own.

import { HANDLE, seenAt, seenLine } from "./edit_shapes.js";

// Lines above the picture. Its methods take CSS pixels, or points of the scene.
export class Overlay {
  constructor(viewer) {
    this.viewer = viewer;
    this.canvas = document.createElement("canvas");
    this.canvas.id = "edit-overlay";
    this.canvas.setAttribute("aria-hidden", "true");
    viewer.canvas.after(this.canvas); // below the panels
    this.context = this.canvas.getContext("2d");
  }

  // Clears it for a picture from a camera.
  begin(camera) {
    const dense = window.devicePixelRatio || 1;
    const { left, top, width, height } = this.viewer.canvas.getBoundingClientRect();
    const [across, down] = [Math.round(width * dense), Math.round(height * dense)];
    if (this.canvas.width !== across) this.canvas.width = across;
    if (this.canvas.height !== down) this.canvas.height = down;
    Object.assign(this.canvas.style, {
      left: `${left}px`,
      top: `${top}px`,
      width: `${width}px`,
      height: `${height}px`,
    });
    this.camera = camera;
    this.scale = [across / camera.W, down / camera.H];
    this.dense = dense;
    this.context.clearRect(0, 0, across, down);
    this.canvas.hidden = true; // a browser may keep showing what was on a canvas that is only cleared
  }

  // Place on this canvas of a column and row of the picture.
  place({ u, v }) {
    return [(u + 0.5) * this.scale[0], (v + 0.5) * this.scale[1]];
  }

  // Strokes a path twice, dark below and bright above, so that it shows on any picture.
  stroke(color = "#ffd24a", dashed = false) {
    const { context, dense } = this;
    this.canvas.hidden = false;
    context.setLineDash(dashed ? [6 * dense, 4 * dense] : []);
    for (const [width, style] of [
      [3.5, "#000a"],
      [1.5, color],
    ]) {
      context.lineWidth = width * dense;
      context.strokeStyle = style;
      context.stroke();
    }
  }

  polyline(points, closed, color) {
    const { context } = this;
    context.beginPath();
    for (const point of points) context.lineTo(...this.place(point));
    if (closed) context.closePath();
    this.stroke(color);
  }

  // A stroke of a brush, as wide as it is.
  band(points, radius) {
    const { context } = this;
    this.canvas.hidden = false;
    context.save();
    Object.assign(context, { lineCap: "round", lineJoin: "round", strokeStyle: "#ffd24a66" });
    context.setLineDash([]);
    context.lineWidth = 2 * radius * this.scale[0];
    context.beginPath();
    for (const point of points) context.lineTo(...this.place(point));
    context.lineTo(...this.place(points[points.length - 1]));
    context.stroke();
    context.restore();
  }

  circle(at, radius, color) {
    const { context } = this;
    context.beginPath();
    context.arc(...this.place(at), radius * this.scale[0], 0, 2 * Math.PI);
    this.stroke(color);
  }

  lines(lines, color, dashed) {
    const { context } = this;
    context.beginPath();
    for (const [a, b] of lines) {
      const seen = seenLine(this.camera, a, b, this.viewer.facts.near);
      if (!seen) continue;
      context.moveTo(...this.place(seen[0]));
      context.lineTo(...this.place(seen[1]));
    }
    this.stroke(color, dashed);
  }

  dot(point, label = "", color = "#ffd24a") {
    const seen = seenAt(this.camera, point);
    if (!(seen.depth > this.viewer.facts.near)) return;
    const { context, dense } = this;
    const [x, y] = this.place(seen);
    context.beginPath();
    context.arc(x, y, HANDLE * 0.6 * dense, 0, 2 * Math.PI);
    context.fillStyle = color;
    context.fill();
    this.stroke("#fff");
    if (label) this.label(x, y, label);
  }

  label(x, y, text) {
    const { context, dense } = this;
    Object.assign(context, { font: `${13 * dense}px system-ui, sans-serif`, lineWidth: 4 * dense, lineJoin: "round" });
    context.setLineDash([]);
    [context.strokeStyle, context.fillStyle] = ["#000c", "#fff"];
    context.strokeText(text, x + 8 * dense, y - 8 * dense);
    context.fillText(text, x + 8 * dense, y - 8 * dense);
  }
}

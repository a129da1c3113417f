// Draws the points and cameras of a capture with WebGL2: the points in one call, all lines in another. Every line is a
// rectangle with vertices of its own: drawn in software, an instance per line takes several times as long.

import { BYTES } from "./capture_cameras.js";
import { linked } from "./common.js";

const POINT = 2; // CSS px, side of a point
const MATCHED = 4; // the same of a matched one

export class CaptureRenderer {
  constructor(canvas, { count }, points, cameras) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl)
      throw new Error(
        "This page draws with WebGL2, which this browser lacks or has switched off. The list of photos works without it.",
      );
    Object.assign(this, { gl, canvas, count, cameras });
    [this.pointProgram, this.lineProgram] = ["capture_points", "capture_lines"].map((name) => linked(gl, name));
    this.points = gl.createVertexArray();
    gl.bindVertexArray(this.points);
    this.filled(new Float32Array(points.buffer, 0, 3 * count));
    this.pointed(0, 3, gl.FLOAT, 0, 0);
    this.filled(points.subarray(12 * count));
    this.pointed(1, 3, gl.UNSIGNED_BYTE, 0, 0);
    this.matched = gl.createVertexArray(); // points of the chosen photo
    this.matchedCount = 0;
    gl.bindVertexArray(this.matched);
    this.matchedPlaces = this.filled(new Float32Array(0));
    this.pointed(0, 3, gl.FLOAT, 0, 0);
    this.lines = gl.createVertexArray();
    gl.bindVertexArray(this.lines);
    this.filled(fourfold(cameras.lines, 9));
    for (const part of [0, 1, 2]) this.pointed(part, 3, gl.FLOAT, 36, 12 * part);
    this.styles = this.filled(this.styled());
    this.pointed(3, 4, gl.UNSIGNED_BYTE, BYTES, 0);
    gl.enableVertexAttribArray(4);
    gl.vertexAttribPointer(4, 2, gl.UNSIGNED_BYTE, false, BYTES, 4);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, cornersOf(cameras.count), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    if (gl.getError() !== gl.NO_ERROR)
      throw new Error("This capture does not fit into the graphics processor's memory.");
  }

  // A new buffer with these numbers, bound.
  filled(values) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    return buffer;
  }

  pointed(location, channels, type, stride, offset) {
    const { gl } = this;
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, channels, type, type !== gl.FLOAT, stride, offset);
  }

  // The points of the chosen photo have changed: x, y and z of each.
  match(positions) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.matchedPlaces);
    gl.bufferData(gl.ARRAY_BUFFER, positions, gl.DYNAMIC_DRAW);
    this.matchedCount = positions.length / 3;
  }

  // The colours and widths of the lines have changed.
  restyled() {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.styles);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, this.styled());
  }

  // The styles of the lines for each corner of their rectangles.
  styled() {
    return fourfold(new Uint32Array(this.cameras.styles.buffer), BYTES / 4);
  }

  // Draws this many points, the matched ones over them, and all lines; `ground` is the colour behind, `mark` that of the
  // matched points, 0 to 255.
  draw(camera, { near, dense, ground, mark, points }) {
    const { gl, canvas } = this;
    if (canvas.width !== camera.W) canvas.width = camera.W;
    if (canvas.height !== camera.H) canvas.height = camera.H;
    gl.viewport(0, 0, camera.W, camera.H);
    gl.clearColor(...ground.map((value) => value / 255), 1);
    gl.enable(gl.DEPTH_TEST);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.seen(this.pointProgram, camera, near, dense);
    gl.bindVertexArray(this.points);
    const side = gl.getUniformLocation(this.pointProgram, "side");
    gl.uniform1f(side, POINT);
    gl.drawArrays(gl.POINTS, 0, Math.min(points, this.count));
    if (this.matchedCount) {
      gl.bindVertexArray(this.matched);
      gl.vertexAttrib3f(1, ...mark.map((value) => value / 255));
      gl.uniform1f(side, MATCHED);
      gl.disable(gl.DEPTH_TEST); // whatever lies before them
      gl.drawArrays(gl.POINTS, 0, this.matchedCount);
      gl.enable(gl.DEPTH_TEST);
    }
    this.seen(this.lineProgram, camera, near, dense);
    gl.uniform1f(gl.getUniformLocation(this.lineProgram, "scale"), this.cameras.scale);
    gl.depthMask(false);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.lines);
    gl.drawElements(gl.TRIANGLES, 6 * this.cameras.count, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
  }

  seen(program, { R, eye, fx, fy, cx, cy, W, H }, near, dense) {
    const { gl } = this;
    const place = (name) => gl.getUniformLocation(program, name);
    gl.useProgram(program);
    gl.uniformMatrix3fv(place("R"), true, R.flat());
    gl.uniform3fv(place("eye"), eye);
    gl.uniform2f(place("focal"), fx, fy);
    gl.uniform2f(place("middle"), cx, cy);
    gl.uniform2f(place("size"), W, H);
    gl.uniform1f(place("near"), near);
    gl.uniform1f(place("dense"), dense);
  }

  // Waits until everything is drawn.
  finish() {
    const { gl } = this;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }
}

// Rows of `width` numbers, each four times.
function fourfold(values, width) {
  const all = new values.constructor(4 * values.length);
  for (let row = 0; row * width < values.length; ++row) {
    const one = values.subarray(row * width, (row + 1) * width);
    for (let corner = 0; corner < 4; ++corner) all.set(one, (4 * row + corner) * width);
  }
  return all;
}

// The corners of the two triangles of each rectangle.
function cornersOf(count) {
  const corners = new Uint32Array(6 * count);
  for (let i = 0; i < count; ++i)
    corners.set(
      [0, 1, 2, 2, 1, 3].map((corner) => 4 * i + corner),
      6 * i,
    );
  return corners;
}

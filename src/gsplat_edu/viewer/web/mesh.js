// Meshes beside the splats: a line across the picture has the splats on its left and the surface on its right. A
// collider lies translucent over both. page_mesh.py writes the data.

import { element, linked, nearestTexture } from "./common.js";
import { edgesOf, rayMeets } from "./mesh_rays.js";
import { inflated } from "./scene.js";
import { plus } from "./vectors.js";

const COLORINGS = { tint: 0, vertices: 1, texture: 2, lines: 3 }; // as in mesh.frag.glsl
const CLAY = [0.75, 0.74, 0.72, 1]; // of a surface without colours
const COLLIDER = [0.25, 0.6, 1, 0.3];
const [DARK_EDGE, LIGHT_EDGE, COLLIDER_EDGE] = [
  [0, 0, 0, 0.6],
  [0.9, 0.9, 0.9, 1],
  [0.1, 0.35, 0.8, 0.9],
];
const SAMPLES = 4; // per pixel, where the graphics processor has as many
const GRIP = 22; // half the width of the line's handle, CSS pixels
export const STEPPING = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Home", "End", "PageUp", "PageDown"];

// The meshes of the page as typed arrays, without their images' pixels.
async function unpackMeshes(entries) {
  const aligned = (length) => 4 * Math.ceil(length / 4);
  const sizeOf = ({ vertices, faces, coloring, image }) =>
    12 * vertices + { none: 0, vertices: 4, texture: 8 }[coloring] * vertices + 12 * faces + aligned(image);
  const total = entries.reduce((sum, entry) => sum + sizeOf(entry), 0);
  const { buffer } = await inflated(document.querySelectorAll("script.meshes"), total);
  let begin = 0;
  const take = (type, count) => {
    const values = new type(buffer, begin, count);
    begin += aligned(values.byteLength);
    return values;
  };
  return entries.map((entry) => ({
    ...entry,
    positions: take(Float32Array, 3 * entry.vertices),
    colors: entry.coloring === "vertices" ? take(Uint8Array, 4 * entry.vertices) : null,
    uvs: entry.coloring === "texture" ? take(Float32Array, 2 * entry.vertices) : null,
    faces: take(Uint32Array, 3 * entry.faces),
    png: take(Uint8Array, entry.image),
  }));
}

// Decodes the texture of a mesh, smaller if it exceeds what the graphics processor can hold; null without one.
async function decodedImage({ png }, most) {
  if (!png.length) return null;
  const blob = new Blob([png], { type: "image/png" });
  const plain = { colorSpaceConversion: "none", premultiplyAlpha: "none" };
  const image = await createImageBitmap(blob, plain);
  const share = most / Math.max(image.width, image.height);
  if (share >= 1) return image;
  const size = { resizeWidth: Math.floor(share * image.width), resizeHeight: Math.floor(share * image.height) };
  return createImageBitmap(blob, { ...plain, ...size, resizeQuality: "high" });
}

// The buffers of one mesh on the graphics processor.
class MeshBuffers {
  constructor(gl, mesh, image) {
    Object.assign(this, { gl, mesh, coloring: mesh.coloring === "none" ? "tint" : mesh.coloring });
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    this.attribute(0, mesh.positions, 3, gl.FLOAT);
    if (mesh.colors) this.attribute(1, mesh.colors, 4, gl.UNSIGNED_BYTE);
    if (mesh.uvs) this.attribute(2, mesh.uvs, 2, gl.FLOAT);
    gl.bindVertexArray(null);
    this.faces = this.indices(mesh.faces);
    this.edges = null; // made when they are drawn first
    this.photo = nearestTexture(gl);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    if (image) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  attribute(location, values, channels, type) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.vertexAttribPointer(location, channels, type, type !== gl.FLOAT, 0, 0);
    gl.enableVertexAttribArray(location);
  }

  indices(values) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, values, gl.STATIC_DRAW);
    return { buffer, count: values.length };
  }

  drawFaces(program, tint, coloring = this.coloring) {
    this.draw(program, tint, coloring, this.faces, this.gl.TRIANGLES);
  }

  drawEdges(program, tint) {
    this.gl.bindVertexArray(null); // it would take the buffer of the edges
    this.edges ??= this.indices(edgesOf(this.mesh));
    this.draw(program, tint, "lines", this.edges, this.gl.LINES);
  }

  draw(program, tint, coloring, { buffer, count }, mode) {
    const { gl } = this;
    gl.uniform1i(gl.getUniformLocation(program, "coloring"), COLORINGS[coloring]);
    gl.uniform4fv(gl.getUniformLocation(program, "tint"), tint);
    gl.uniform1i(gl.getUniformLocation(program, "photo"), 0);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.photo);
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
    gl.drawElements(mode, count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }
}

// An image that is drawn with depths and several samples per pixel, then resolved into a texture.
class Layer {
  constructor(gl) {
    Object.assign(this, { gl, width: 0, height: 0, key: "", texture: null });
    [this.drawn, this.resolved] = [gl.createFramebuffer(), gl.createFramebuffer()];
    [this.colors, this.depths] = [gl.createRenderbuffer(), gl.createRenderbuffer()];
  }

  resize(width, height) {
    const { gl } = this;
    if (this.width === width && this.height === height) return;
    const samples = Math.min(SAMPLES, gl.getParameter(gl.MAX_SAMPLES));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.drawn);
    for (const [buffer, format, place] of [
      [this.colors, gl.RGBA8, gl.COLOR_ATTACHMENT0],
      [this.depths, gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT],
    ]) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, samples, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
    }
    gl.deleteTexture(this.texture);
    this.texture = nearestTexture(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.resolved);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
    [this.width, this.height] = [width, height];
  }

  // Draws by a function over a background, premultiplied by its opacity.
  fill(background, draw) {
    const { gl, width, height } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.drawn);
    gl.viewport(0, 0, width, height);
    gl.clearBufferfv(gl.COLOR, 0, background);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    draw();
    gl.disable(gl.DEPTH_TEST);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.drawn);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.resolved);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }
}

export class Meshes {
  static async open(viewer) {
    const { gl } = viewer.renderer;
    const meshes = await unpackMeshes(viewer.facts.meshes);
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const images = await Promise.all(meshes.map((mesh) => decodedImage(mesh, most)));
    return new Meshes(viewer, meshes, images);
  }

  constructor(viewer, [surface, collider = null], images) {
    const { gl } = viewer.renderer;
    Object.assign(this, { viewer, gl, program: linked(gl, "mesh"), surface, collider });
    this.buffers = [surface, collider].map((mesh, i) => mesh && new MeshBuffers(gl, mesh, images[i]));
    [this.below, this.above] = [new Layer(gl), new Layer(gl)]; // the surface, and the collider over everything
    this.placed = {
      R: [
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, 1],
      ],
      t: [0, 0, 0],
    }; // where edits have moved the whole scene
    this.style = "surface"; // or "edges" on it, or "wireframe"
    this.showsCollider = collider !== null;
    this.share = viewer.facts.edit ? 1 : 0.5; // of the picture's width, from the left, that shows the splats
    if (gl.getError() !== gl.NO_ERROR) throw new Error("The mesh does not fit into the graphics processor's memory.");
    this.setUpPanel();
  }

  setUpPanel() {
    const [range, style, collider] = ["mesh-share", "mesh-style", "mesh-collider"].map(element);
    const count = this.surface.faces.length / 3;
    element("mesh-count").textContent = `${count.toLocaleString("en")} triangles`;
    for (const id of ["mesh", "mesh-line", "mesh-help"]) element(id).hidden = false;
    element("mesh-stays").hidden = !this.surface.stays;
    collider.parentElement.hidden = !this.collider;
    collider.checked = this.showsCollider;
    range.addEventListener("input", () => this.split(Number(range.value) / 100));
    range.addEventListener("keydown", (event) => STEPPING.includes(event.key) && event.stopPropagation());
    style.addEventListener("change", () => {
      this.style = style.value;
      style.blur(); // otherwise it would keep receiving the keys
      this.viewer.repaint();
    });
    collider.addEventListener("change", () => {
      this.showsCollider = collider.checked;
      this.viewer.repaint();
    });
    const line = element("mesh-line");
    line.addEventListener("pointerdown", (event) => {
      line.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    line.addEventListener("pointermove", (event) => {
      if (!line.hasPointerCapture(event.pointerId)) return;
      const { left, width } = this.shown();
      this.split((event.clientX - left) / width);
    });
    this.split(this.share);
  }

  // For the editor: the whole scene was moved by {R, t}; stays: some splats were moved without the others.
  place({ R, t }, stays) {
    this.placed = { R, t };
    element("mesh-stays").hidden = !stays;
  }

  // Moves the line.
  split(share) {
    this.share = Math.min(1, Math.max(0, share));
    const percent = Math.round(100 * this.share);
    const range = element("mesh-share");
    range.value = percent;
    range.setAttribute("aria-valuetext", `splats ${percent} %, mesh ${100 - percent} %`);
    this.viewer.repaint();
  }

  // Where the picture is in the window, CSS pixels: the canvas contains it whole.
  shown() {
    const { left, width, height } = this.gl.canvas.getBoundingClientRect();
    const across = Math.min(width, (height * this.gl.canvas.width) / this.gl.canvas.height);
    return { left: left + (width - across) / 2, width: across };
  }

  // Whether a column of the picture shows the surface.
  covers(camera, column) {
    return column + 0.5 > this.share * camera.W;
  }

  // Camera depth of the surface at a place in the picture; null if there is none.
  depthAt({ R, eye, fx, fy, cx, cy }, u, v) {
    const ray = [(u - cx) / fx, (v - cy) / fy, 1];
    const direction = [0, 1, 2].map((axis) => R[0][axis] * ray[0] + R[1][axis] * ray[1] + R[2][axis] * ray[2]);
    const { R: turn, t } = this.placed;
    const back = (v) => [0, 1, 2].map((i) => turn[0][i] * v[0] + turn[1][i] * v[1] + turn[2][i] * v[2]);
    const depth = rayMeets(this.surface, back(plus(eye, t, -1)), back(direction), this.viewer.facts.near);
    return depth < Infinity ? depth : null;
  }

  // Shows the meshes over the picture of the splats.
  show(camera) {
    const { gl, viewer } = this;
    this.draw(camera);
    const { width, height } = gl.canvas;
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (this.share < 1) {
      const begin = Math.round(this.share * width);
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(begin, 0, width - begin, height);
      viewer.renderer.copy(this.below.texture, this.below.width, this.below.height);
      gl.disable(gl.SCISSOR_TEST);
    }
    if (this.showsCollider) viewer.renderer.copy(this.above.texture, this.above.width, this.above.height);
    gl.disable(gl.BLEND);
    const { left, width: across } = this.shown();
    const at = Math.min(Math.max(left + this.share * across, left + GRIP), left + across - GRIP);
    element("mesh-line").style.left = `${at}px`;
  }

  // Draws what has changed since the last picture.
  draw(camera) {
    const [surface, collider] = this.buffers;
    const { R, eye, fx, fy, cx, cy, W, H } = camera;
    const { background } = this.viewer.settings;
    const key = JSON.stringify([R, eye, fx, fy, cx, cy, W, H, background, this.style, this.placed]);
    if (this.below.key !== key && this.share < 1) {
      this.begin(this.below, camera);
      this.below.fill([...background, 1], () => this.drawSurface(surface, background));
      this.below.key = key;
    }
    if (this.showsCollider && this.above.key !== key) {
      this.begin(this.above, camera);
      this.above.fill([0, 0, 0, 0], () => this.drawCollider(collider));
      this.above.key = key;
    }
  }

  begin(layer, camera) {
    const { gl, program } = this;
    const place = (name) => gl.getUniformLocation(program, name);
    layer.resize(camera.W, camera.H);
    gl.useProgram(program);
    gl.uniformMatrix3fv(place("turn"), true, this.placed.R.flat());
    gl.uniform3fv(place("shift"), this.placed.t);
    gl.uniformMatrix3fv(place("R"), true, camera.R.flat());
    gl.uniform3fv(place("eye"), camera.eye);
    gl.uniform2f(place("focal"), camera.fx, camera.fy);
    gl.uniform2f(place("middle"), camera.cx, camera.cy);
    gl.uniform2f(place("size"), camera.W, camera.H);
    gl.uniform1f(place("near"), this.viewer.facts.near);
  }

  drawSurface(buffers, background) {
    if (this.style === "surface") return buffers.drawFaces(this.program, CLAY);
    const isWireframe = this.style === "wireframe";
    const isBright = background[0] + background[1] + background[2] > 1.5;
    this.behindEdges(!isWireframe, () => buffers.drawFaces(this.program, CLAY));
    return buffers.drawEdges(this.program, isWireframe && !isBright ? LIGHT_EDGE : DARK_EDGE);
  }

  // Only the nearest faces of the collider are seen, and their edges.
  drawCollider(buffers) {
    this.behindEdges(false, () => buffers.drawFaces(this.program, COLLIDER, "tint"));
    this.behindEdges(true, () => buffers.drawFaces(this.program, COLLIDER, "tint"));
    buffers.drawEdges(this.program, COLLIDER_EDGE);
  }

  // Draws faces a little behind their edges, which are drawn later; only their depths if they are not visible.
  behindEdges(isVisible, draw) {
    const { gl } = this;
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1, 1);
    gl.colorMask(isVisible, isVisible, isVisible, isVisible);
    draw();
    gl.colorMask(true, true, true, true);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }

  // For programs: draws the surface with exactly this camera and returns RGB in bytes, with the first row on top.
  pixels(camera) {
    const { gl, below } = this;
    const share = this.share;
    this.share = 0;
    this.draw(camera);
    this.share = share;
    const rgba = new Uint8Array(4 * camera.W * camera.H);
    gl.bindFramebuffer(gl.FRAMEBUFFER, below.resolved);
    gl.readPixels(0, 0, camera.W, camera.H, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    const rgb = new Uint8Array(3 * camera.W * camera.H);
    for (let y = 0, to = 0; y < camera.H; ++y) {
      for (let x = 0; x < camera.W; ++x, to += 3) {
        const from = 4 * ((camera.H - 1 - y) * camera.W + x);
        rgb.set(rgba.subarray(from, from + 3), to);
      }
    }
    return rgb;
  }
}

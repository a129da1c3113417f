// Drawing with WebGL2: the splats, far to near, into a half-float image, which is then copied to the canvas.
//
// Eight bits are too few for blending a hundred faint splats: the rounding would be visible. The renderer may stop once
// the transmittance is below 1e-4; drawing does not stop here, and the difference is invisible.

import { ratioBounds } from "./camera.js";
import { linked, nearestTexture } from "./common.js";
import { layout } from "./scene.js";
import { SeenTexture } from "./seen.js";

export const SOLID = 0.15; // smallest half of the opacity of a pixel that shows a surface
const BATCH_SPLATS = 4096; // splats per instance: one each would cost a software rasteriser 20 µs per splat
const SURFACE_STEPS = 10; // bisections of log depth, starting from a factor of 2: accurate to 0.07 %

const POLL = 4; // milliseconds between two looks whether a picture is drawn
const QUAD = [0, 1, 2, 2, 1, 3]; // corners of the two triangles
export const ORDER = { type: Uint32Array, channels: 1, texels: 1 }; // splats, far to near

export class Renderer {
  constructor(canvas, splats, facts) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!gl)
      throw new Error(
        "This page draws with WebGL2, which this browser lacks or has switched off. Allow hardware acceleration, use another browser, or make a video: gsplat-edu render",
      );
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("This page needs half-float render targets, which this graphics processor does not support.");
    }
    this.gl = gl;
    this.facts = facts;
    this.count = 0;
    this.program = linked(gl, "splat");
    this.screen = linked(gl, "screen");
    this.textureWidth = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.textures = layout(facts).map((part) => this.uploaded(part, splats[part.name]));
    this.next = null; // splats that wait for their order
    this.image = null;
    this.begun = 0; // images
    this.thinning = 0;
    this.framebuffer = gl.createFramebuffer();
    this.setUpOrder();
    this.seen = facts.seen ? new SeenTexture(this) : null;
    if (gl.getError() !== gl.NO_ERROR) throw new Error("This scene does not fit into the graphics processor's memory.");
    gl.disable(gl.DITHER);
  }

  // Formats of a texture: stored, given, and the type of a number.
  kind(type, channels) {
    const gl = this.gl;
    return {
      [`${Float32Array.name}3`]: [gl.RGB32F, gl.RGB, gl.FLOAT],
      [`${Int16Array.name}4`]: [gl.RGBA16I, gl.RGBA_INTEGER, gl.SHORT],
      [`${Uint16Array.name}3`]: [gl.RGB16F, gl.RGB, gl.HALF_FLOAT],
      [`${Uint16Array.name}1`]: [gl.R16F, gl.RED, gl.HALF_FLOAT],
      [`${Uint32Array.name}1`]: [gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT],
    }[`${type.name}${channels}`];
  }

  // Copies `count` splats, from index `from` of some arrays, to index `to` of the textures.
  write(arrays, from, to, count) {
    const gl = this.gl;
    const width = this.textureWidth;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    layout(this.facts).forEach(({ name, type, channels, texels }, unit) => {
      const [, format, kind] = this.kind(type, channels);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, this.textures[unit]);
      for (let done = 0; done < count * texels; ) {
        const place = to * texels + done;
        const [row, column] = [Math.floor(place / width), place % width];
        const here = Math.min(count * texels - done, width - column);
        const begin = channels * (from * texels + done);
        const values = arrays[name].subarray(begin, begin + channels * here);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, column, row, here, 1, format, kind, values);
        done += here;
      }
    });
  }

  // Uploads other splats, in place of all; they are drawn from the next order on, which has to be theirs.
  replace(facts, splats) {
    const textures = layout(facts).map((part) => this.uploaded(part, splats[part.name], facts.count));
    this.next = { facts, textures };
  }

  // Draws the splats that `replace` uploaded.
  adopt() {
    const gl = this.gl;
    this.textures.forEach((texture) => gl.deleteTexture(texture));
    ({ facts: this.facts, textures: this.textures } = this.next);
    this.next = null;
    gl.deleteTexture(this.order);
    this.order = this.uploaded(ORDER, null);
  }

  // Makes a texture of an array; without one, write() or fill() fills it later.
  uploaded(part, values, count = this.facts.count) {
    const gl = this.gl;
    const [stored] = this.kind(part.type, part.channels);
    const width = this.textureWidth;
    const height = Math.max(1, Math.ceil((count * part.texels) / width));
    if (height > width) throw new Error("This scene has more splats than this graphics processor's textures can hold.");
    const texture = nearestTexture(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, stored, width, height);
    if (values) this.fill(texture, part, values);
    return texture;
  }

  // Copies an array to the beginning of a texture, row by row.
  fill(texture, { channels, type }, values) {
    const gl = this.gl;
    const [, format, kind] = this.kind(type, channels);
    const width = this.textureWidth;
    const full = Math.floor(values.length / channels / width);
    const rest = values.length / channels - full * width;
    const split = full * width * channels;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, full, format, kind, values.subarray(0, split));
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, full, rest, 1, format, kind, values.subarray(split));
  }

  // Two triangles for each splat of a batch; the shader finds the splat in a texture.
  setUpOrder() {
    const gl = this.gl;
    this.order = this.uploaded(ORDER, null);
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    const corners = Uint16Array.from({ length: 6 * BATCH_SPLATS }, (_, i) => 4 * Math.floor(i / 6) + QUAD[i % 6]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  // Sets what is drawn: these splats, far to near. Of a sample, `thinning` is above 0.
  setOrder(order, thinning = 0) {
    this.thinning = thinning;
    if (this.next) this.adopt();
    this.fill(this.order, ORDER, order);
    this.count = order.length;
  }

  // Creates the image to draw into if its size has changed.
  resize(width, height) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    if (this.image && this.width === width && this.height === height) return;
    gl.deleteTexture(this.image);
    this.image = nearestTexture(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
    [this.width, this.height] = [width, height];
  }

  // Draws the splats up to a camera depth in the current order: image = alpha colour + (1 - alpha) image, starting with
  // the background.
  draw(camera, settings, background = [...settings.background, 1], farthest = 3e38) {
    this.begin(camera, background);
    this.drawPart(camera, settings, 0, this.count, farthest);
  }

  // Begins an image; returns what tells whether another one has been begun since.
  begin(camera, background) {
    const gl = this.gl;
    this.resize(camera.W, camera.H);
    gl.clearBufferfv(gl.COLOR, 0, background);
    return ++this.begun;
  }

  // Draws splats from one place in the order to another.
  drawPart(camera, settings, from, to, farthest = 3e38) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, camera.W, camera.H);
    gl.useProgram(this.program);
    this.setUniforms(camera, settings);
    gl.uniform1f(gl.getUniformLocation(this.program, "farthest"), farthest);
    gl.uniform1i(gl.getUniformLocation(this.program, "first"), from);
    gl.uniform1i(gl.getUniformLocation(this.program, "end"), to);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.vertices);
    const [splats, batches] = [Math.min(to - from, BATCH_SPLATS), Math.ceil((to - from) / BATCH_SPLATS)];
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * splats, gl.UNSIGNED_SHORT, 0, batches);
    gl.bindVertexArray(null);
  }

  setUniforms(camera, settings) {
    const gl = this.gl;
    const place = (name) => gl.getUniformLocation(this.program, name);
    layout(this.facts).forEach(({ name }, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, this.textures[unit]);
      gl.uniform1i(place(name), unit);
    });
    gl.activeTexture(gl.TEXTURE0 + this.textures.length);
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.uniform1i(place("order"), this.textures.length);
    this.seen?.bind();
    gl.uniform1i(place("batch_splats"), BATCH_SPLATS);
    gl.uniform1f(place("thinning"), this.thinning);
    const { low, high, widest } = ratioBounds(camera, settings);
    gl.uniform1i(place("texture_width"), this.textureWidth);
    gl.uniform1i(place("coefficients"), (this.facts.sh_degree + 1) ** 2);
    gl.uniform1i(place("degree"), Math.min(settings.sh_degree, this.facts.sh_degree));
    gl.uniform1i(place("antialiased"), settings.antialiased ? 1 : 0);
    gl.uniformMatrix3fv(place("R"), true, camera.R.flat());
    gl.uniform3fv(place("eye"), camera.eye);
    gl.uniform2f(place("focal"), camera.fx, camera.fy);
    gl.uniform2f(place("middle"), camera.cx, camera.cy);
    gl.uniform2f(place("size"), camera.W, camera.H);
    gl.uniform2fv(place("ratio_low"), low);
    gl.uniform2fv(place("widest"), widest);
    gl.uniform2fv(place("ratio_high"), high);
  }

  // Camera depth of the visible surface at a pixel: where half of the pixel's opacity is reached; null if there is
  // little. The image has to be drawn again afterwards.
  surface(camera, settings, column, row) {
    const gl = this.gl;
    const { near } = this.facts;
    gl.enable(gl.SCISSOR_TEST); // only this pixel is drawn
    gl.scissor(column, camera.H - 1 - row, 1, 1);
    const pixel = new Float32Array(4);
    const opacity = (farthest) => {
      this.draw(camera, settings, [0, 0, 0, 0], farthest);
      gl.readPixels(column, camera.H - 1 - row, 1, 1, gl.RGBA, gl.FLOAT, pixel);
      return pixel[3];
    };
    const half = 0.5 * opacity(3e38);
    let [low, high] = [near, 2 * near];
    if (half >= SOLID) {
      while (opacity(high) < half) [low, high] = [high, 2 * high];
      for (let i = 0; i < SURFACE_STEPS; ++i) {
        const middle = Math.sqrt(low * high);
        if (opacity(middle) < half) low = middle;
        else high = middle;
      }
    }
    gl.disable(gl.SCISSOR_TEST);
    return half >= SOLID ? high : null;
  }

  // Copies the image onto the canvas, or elsewhere; see copy().
  show(place) {
    this.gl.disable(this.gl.BLEND);
    this.copy(this.image, this.width, this.height, place);
  }

  // Copies a texture of a size onto the canvas, or onto a part {framebuffer, x, y, width, height} of a framebuffer, enlarged
  // if that is larger.
  copy(texture, imageWidth, imageHeight, place = null) {
    const gl = this.gl;
    const { framebuffer = null, x = 0, y = 0, width, height } = place ?? gl.canvas;
    const enlarged = width !== imageWidth || height !== imageHeight;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(x, y, width, height);
    gl.useProgram(this.screen);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, enlarged ? gl.LINEAR : gl.NEAREST);
    gl.uniform1i(gl.getUniformLocation(this.screen, "enlarged"), enlarged ? 1 : 0);
    gl.uniform2f(gl.getUniformLocation(this.screen, "corner"), x, y);
    gl.uniform2f(gl.getUniformLocation(this.screen, "size"), width, height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Resolves with the milliseconds until what was asked for so far is drawn; the page stays awake meanwhile.
  drawn() {
    const gl = this.gl;
    const began = performance.now();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    return new Promise((resolve) => {
      const look = () => {
        const done = gl.isContextLost() || gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED;
        if (!done) return void setTimeout(look, POLL);
        gl.deleteSync(fence);
        resolve(performance.now() - began);
      };
      setTimeout(look, 0);
    });
  }

  // Waits until everything is drawn.
  finish() {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, new Float32Array(4));
  }

  // Returns the image as float32 RGB, first row on top.
  pixels() {
    const gl = this.gl;
    const { width, height } = this;
    const rgba = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, rgba);
    const rgb = new Float32Array(3 * width * height);
    for (let y = 0, to = 0; y < height; ++y) {
      for (let from = 4 * width * (height - 1 - y); to < 3 * width * (y + 1); from += 4, to += 3) {
        rgb.set(rgba.subarray(from, from + 3), to);
      }
    }
    return rgb;
  }
}

// What the editor draws: the state of the splats inside the picture, and lines above it.

import { nearestTexture } from "./common.js";
import { Renderer } from "./draw.js";
import { MotionTextures } from "./edit_move.js";

export const HIGHLIGHT = [1, 0.75, 0.1]; // colour of selected splats

// The states as a texture that the shader reads: hidden and deleted splats are not drawn, selected ones are coloured.
export class FlagTexture {
  constructor(renderer) {
    const gl = renderer.gl;
    this.renderer = renderer;
    this.width = renderer.textureWidth;
    this.unit = renderer.textures.length + 1; // behind the order
    gl.activeTexture(gl.TEXTURE0 + this.unit);
    this.texture = nearestTexture(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R8UI, this.width, Math.max(1, Math.ceil(renderer.facts.count / this.width)));
  }

  bind() {
    const { gl, program } = this.renderer;
    gl.activeTexture(gl.TEXTURE0 + this.unit);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.uniform1i(gl.getUniformLocation(program, "flags"), this.unit);
    gl.uniform3fv(gl.getUniformLocation(program, "highlight"), HIGHLIGHT);
  }

  write(flags) {
    const { gl } = this.renderer;
    const { width } = this;
    gl.activeTexture(gl.TEXTURE0 + this.unit);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    for (let done = 0; done < flags.length; done += width) {
      const here = Math.min(width, flags.length - done);
      const rows = here === width ? Math.floor((flags.length - done) / width) : 1;
      const values = flags.subarray(done, done + here * rows);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, done / width, here, rows, gl.RED_INTEGER, gl.UNSIGNED_BYTE, values);
      done += width * (rows - 1);
    }
  }
}

// Every renderer of the page gets the texture, from its first picture on: the shader needs it.
const drawsWithoutFlags = Renderer.prototype.setUniforms;
Renderer.prototype.setUniforms = function (camera, settings) {
  drawsWithoutFlags.call(this, camera, settings);
  this.flags ??= new FlagTexture(this);
  this.flags.bind();
  this.motion ??= new MotionTextures(this);
  this.motion.bind(this.flags);
};

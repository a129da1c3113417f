// How the picture shows the splats and the selection: tinted, by their centres, by rings, and with an outline.

import { linked } from "./common.js";
import { ORDER, Renderer } from "./draw.js";
import { HIGHLIGHT } from "./edit_draw.js";
import { SELECTED } from "./edit_flags.js";
import { DETAILS, reduced } from "./pace.js";
import { layout } from "./scene.js";

const TINT = { tint: 0.6, centres: 0, rings: 0.75 }; // share of the highlight in the colour of a selected splat
const MASK_SHARE = 0.5; // of the picture's size: the mask of the outline
const DOTS = [
  { selected: 0, color: [0.3, 0.62, 1, 0.7], size: 2 }, // sizes in CSS pixels
  { selected: 1, color: [...HIGHLIGHT, 1], size: 3 },
];
const MOST_KEPT = DETAILS.at(-1).most; // selected splats that a coarse picture always has
const OUTLINE_WIDTH = 2; // CSS pixels

export const LOOK_ROW = `
<p class="row" role="group" aria-label="how the selection is shown">
<button data-look="tint" aria-pressed="true" title="6: tint the selected splats">tint</button>
<button data-look="centres" aria-pressed="false" title="7: show the centre of every splat">centres</button>
<button data-look="rings" aria-pressed="false" title="8: show every splat as a ring">rings</button>
<button data-look="outline" aria-pressed="false" title="9: outline the selection in place of the tint, also where it is hidden">outline</button>
<button data-do="grid" aria-pressed="false" title="Show a grid on the ground">grid</button>
</p>`;

// Every renderer of the page gets the uniforms of its look; an editor sets the look.
const drawsWithoutLook = Renderer.prototype.setUniforms;
Renderer.prototype.setUniforms = function (camera, settings) {
  drawsWithoutLook.call(this, camera, settings);
  const { gl, program } = this;
  const { tint, rings } = this.look ?? { tint: TINT.tint, rings: 0 };
  gl.uniform1f(gl.getUniformLocation(program, "highlight_share"), tint);
  gl.uniform1f(gl.getUniformLocation(program, "ring_width"), rings);
  gl.uniform1f(gl.getUniformLocation(program, "kept"), this.kept ?? 0);
};

export class EditLook {
  constructor(editor) {
    const { viewer } = editor;
    const { gl } = viewer.renderer;
    Object.assign(this, {
      editor,
      viewer,
      kind: "tint",
      outlined: false,
      hidden: false,
      selected: null,
      unseen: false,
    });
    this.dots = linked(gl, "edit_dots");
    this.edge = linked(gl, "edit_edge");
    this.mask = { framebuffer: gl.createFramebuffer(), image: null, width: 0, height: 0 };
    this.order = null; // the selected splats as a texture, once there is an outline
  }

  choose(name) {
    if (name === "outline") this.outlined = !this.outlined;
    else this.kind = name;
    for (const button of this.editor.panel.root.querySelectorAll("[data-look]")) {
      const { look } = button.dataset;
      button.setAttribute("aria-pressed", look === "outline" ? this.outlined : look === this.kind);
    }
    this.apply();
  }

  // Shows the splats as the scene has them, without the selection, or as chosen.
  hide(hidden) {
    this.hidden = hidden;
    this.apply();
  }

  apply() {
    const dense = window.devicePixelRatio || 1;
    const chosen = this.outlined && this.kind === "tint" ? 0 : TINT[this.kind];
    const rings = this.kind === "rings" ? dense : 0;
    this.unseen = true;
    this.viewer.renderer.look = this.hidden ? { tint: 0, rings: 0 } : { tint: chosen, rings };
    this.viewer.refresh();
  }

  // The states of the splats have changed. Every coarse picture has the selected splats, or of many an even share, so that
  // a selection shows before the whole picture is drawn.
  changed() {
    const { flags } = this.editor.history;
    this.selected = indicesOf(flags, SELECTED);
    this.unseen = true;
    const step = Math.max(1, Math.ceil(this.selected.length / MOST_KEPT));
    this.viewer.sorter.keep(this.selected.filter((_, i) => i % step === 0));
    this.viewer.renderer.kept = 1 / step;
  }

  // Calls work() while splats are drawn as the scene has them.
  plainly(work) {
    const { renderer } = this.viewer;
    const { look } = renderer;
    renderer.look = { tint: 0, rings: 0 };
    const result = work();
    renderer.look = look;
    return result;
  }

  // Draws above the picture on the canvas.
  draw(camera) {
    const { viewer } = this;
    if (viewer.lost || this.hidden || (this.kind !== "centres" && !this.outlined)) return;
    const hurried = viewer.pace.slow && viewer.isMoving() && !this.unseen;
    this.unseen = false;
    if (this.outlined && this.selected.length && !hurried) this.drawOutline(camera);
    this.stride = hurried ? Math.max(1, Math.ceil(this.editor.values.count / viewer.pace.detail.most)) : 1;
    if (this.kind === "centres")
      for (const dots of DOTS) if (!dots.selected || this.selected.length) this.drawDots(camera, dots);
  }

  // Draws on the canvas with a program of ours.
  begin(program) {
    const { gl } = this.viewer.renderer;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.canvas.width, gl.canvas.height);
    gl.useProgram(program);
    return (name) => gl.getUniformLocation(program, name);
  }

  drawDots(camera, { selected, color, size }) {
    const { renderer } = this.viewer;
    const { gl, facts, flags } = renderer;
    const place = this.begin(this.dots);
    const means = layout(facts).findIndex(({ name }) => name === "means");
    for (const [name, unit, texture] of [
      ["means", means, renderer.textures[means]],
      ["flags", flags.unit, flags.texture],
    ]) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(place(name), unit);
    }
    gl.uniform1i(place("texture_width"), renderer.textureWidth);
    gl.uniform1ui(place("wanted"), selected);
    gl.uniform1i(place("stride"), this.stride);
    gl.uniformMatrix3fv(place("R"), true, camera.R.flat());
    gl.uniform3fv(place("eye"), camera.eye);
    gl.uniform2f(place("focal"), camera.fx, camera.fy);
    gl.uniform2f(place("middle"), camera.cx, camera.cy);
    gl.uniform2f(place("size"), camera.W, camera.H);
    gl.uniform1f(place("width"), size * (window.devicePixelRatio || 1));
    gl.uniform4fv(place("paint"), color);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.POINTS, 0, Math.ceil(facts.count / this.stride));
    gl.disable(gl.BLEND);
  }

  // Outlines where the selected splats would cover the picture, if there were no others.
  drawOutline(camera) {
    this.drawMask(camera);
    const { gl } = this.viewer.renderer;
    const place = this.begin(this.edge);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.mask.image);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.uniform1i(place("mask"), 0);
    gl.uniform2f(place("size"), gl.canvas.width, gl.canvas.height);
    gl.uniform1f(place("width"), OUTLINE_WIDTH * (window.devicePixelRatio || 1));
    gl.uniform3fv(place("paint"), HIGHLIGHT);
    gl.disable(gl.BLEND);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Draws the selected splats alone into the mask, with the renderer. Their opacities add up to the same in any order.
  drawMask(camera) {
    const { renderer, settings } = this.viewer;
    this.order ??= renderer.uploaded(ORDER, null);
    renderer.fill(this.order, ORDER, this.selected);
    const { framebuffer, image, width, height, begun, order, count, thinning } = renderer;
    Object.assign(renderer, this.mask, { order: this.order, count: this.selected.length, thinning: 0 });
    this.plainly(() => renderer.draw(reduced(camera, MASK_SHARE), settings, [0, 0, 0, 0]));
    this.mask = {
      framebuffer: renderer.framebuffer,
      image: renderer.image,
      width: renderer.width,
      height: renderer.height,
    };
    Object.assign(renderer, { framebuffer, image, width, height, begun, order, count, thinning });
  }
}

// The places at which an array has a value.
function indicesOf(array, value) {
  const found = new Uint32Array(array.length);
  let count = 0;
  for (let i = 0; i < array.length; ++i) if (array[i] === value) found[count++] = i;
  return found.slice(0, count);
}

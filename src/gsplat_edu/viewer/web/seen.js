// Which splats few photos saw: page_proof.py counts the photos, one byte per splat, and the shader tints such splats.

import { element, nearestTexture } from "./common.js";
import { inflated } from "./scene.js";

const UNSEEN = [230 / 255, 159 / 255, 0]; // orange on grey: told apart with any colour vision (Okabe and Ito)

// The counts as a texture that the shader reads; zeros until they are unpacked.
export class SeenTexture {
  constructor(renderer) {
    const { gl, textureWidth, facts } = renderer;
    Object.assign(this, { renderer, fewest: 0, faded: 0, unit: renderer.textures.length + 2 }); // behind the order and the flags
    gl.activeTexture(gl.TEXTURE0 + this.unit);
    this.texture = nearestTexture(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R8UI, textureWidth, Math.max(1, Math.ceil(facts.count / textureWidth)));
  }

  write(counts) {
    const { gl, textureWidth: width } = this.renderer;
    gl.activeTexture(gl.TEXTURE0 + this.unit);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    for (let begin = 0; begin < counts.length; begin += width) {
      const row = counts.subarray(begin, begin + width);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, begin / width, row.length, 1, gl.RED_INTEGER, gl.UNSIGNED_BYTE, row);
    }
  }

  bind() {
    const { gl, program } = this.renderer;
    gl.activeTexture(gl.TEXTURE0 + this.unit);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.uniform1i(gl.getUniformLocation(program, "photos_seen"), this.unit);
    gl.uniform1ui(gl.getUniformLocation(program, "fewest"), this.fewest);
    gl.uniform1ui(gl.getUniformLocation(program, "faded"), this.fewest ? 0 : this.faded);
    gl.uniform3fv(gl.getUniformLocation(program, "tint"), UNSEEN);
  }
}

// The switch and its legend.
export class Seen {
  static async open(viewer) {
    const counts = await inflated(document.querySelectorAll("script.seen"), viewer.facts.count);
    return new Seen(viewer, counts);
  }

  constructor(viewer, counts) {
    Object.assign(this, { viewer, on: false });
    viewer.renderer.seen.write(counts);
    const button = element("seen");
    offer(button);
    button.addEventListener("click", () => this.toggle());
  }

  toggle() {
    const { fewest, share } = this.viewer.facts.seen;
    this.on = !this.on;
    this.viewer.renderer.seen.fewest = this.on ? fewest : 0;
    element("seen").setAttribute("aria-pressed", this.on);
    element("legend").hidden = !this.on;
    const percent = share > 0 && share < 0.01 ? "less than 1" : Math.round(100 * share);
    element("legend").lastElementChild.textContent = this.on
      ? `Orange: no photo shows this, or only one (${percent} % of the splats). Grey: two or more do.`
      : "";
    this.viewer.refresh();
  }
}

// Shows a button of the panel, and its line in the help.
export function offer(button) {
  for (const hidden of [button, ...document.querySelectorAll(`#help [data-for=${button.id}]`)]) hidden.hidden = false;
}

// For browsers without WebGL2: the computer that serves the page renders, and the page shows its pictures.

import { fitted } from "./camera.js";
import { element, say } from "./common.js";
import { FACTS } from "./facts.js";
import { Viewer } from "./viewer.js";

const PICTURE_SIDE = 800; // longest side of a picture while the training runs, px
const STILL_SIDE = 1600; // while it waits or is finished

// Takes the place of Renderer.
class Pictures {
  // address: URL of the pictures, relative to the page. onResult(line): called after each request, with the reason if there
  // is no picture, and with "" if there is one.
  constructor(canvas, address, onResult) {
    Object.assign(this, { canvas, address, onResult, asking: false, wanted: null, still: false, failure: "" });
    this.context = canvas.getContext("2d");
  }

  setOrder() {}

  replace() {}

  show() {}

  surface() {
    return null;
  }

  // Asks for a picture from this camera; of several, the last one counts.
  draw(camera) {
    this.wanted = camera;
    if (!this.asking) this.ask();
  }

  async ask() {
    this.asking = true;
    while (this.wanted) {
      const camera = this.wanted;
      this.wanted = null;
      const share = Math.min(1, (this.still ? STILL_SIDE : PICTURE_SIDE) / Math.max(camera.W, camera.H));
      const side = (length) => Math.max(1, Math.round(share * length));
      const { R, eye, fx, fy, cx, cy, W, H } = fitted(camera, side(camera.W), side(camera.H));
      try {
        const answer = await fetch(this.address, {
          method: "POST",
          headers: { "Content-Type": "application/json" },
          body: JSON.stringify({ R, eye, fx, fy, cx, cy, W, H }),
        });
        if (!answer.ok) throw new Error(lineOfError(await answer.text()));
        const picture = await createImageBitmap(await answer.blob());
        this.context.drawImage(picture, 0, 0, this.canvas.width, this.canvas.height);
        this.failure = "";
      } catch (error) {
        this.failure =
          error instanceof TypeError ? "The program that draws the pictures cannot be reached." : error.message;
      }
      this.onResult(this.failure);
    }
    this.asking = false;
  }
}

// The server's line, as text or in JSON.
function lineOfError(text) {
  try {
    return JSON.parse(text).error;
  } catch {
    return text.trim();
  }
}

const hasWebGL2 = () => {
  const gl = document.createElement("canvas").getContext("webgl2");
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return gl !== null;
};

// This listener comes before that of viewer.js.
addEventListener("DOMContentLoaded", (event) => {
  if (hasWebGL2()) return;
  event.stopImmediatePropagation();
  const showResult = (line) => {
    say(line);
    element("count").textContent =
      `${FACTS.count.toLocaleString("en")} splats, drawn by the program that serves this page: this browser has no WebGL2`;
  };
  class PictureViewer extends Viewer {
    makeRenderer() {
      const pictures = new Pictures(this.canvas, FACTS.pictures ?? "picture", FACTS.live ? () => {} : showResult);
      pictures.still = !FACTS.live;
      return pictures;
    }
  }
  const viewer = new PictureViewer({ ...FACTS, sh_degree: 0 }, { means: new Float32Array(0) });
  window.viewer = viewer;
  say("");
  dispatchEvent(new CustomEvent("viewer", { detail: { viewer, splats: null } }));
});

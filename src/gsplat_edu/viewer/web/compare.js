// Photos beside the picture: the view is at a photo's camera, and a line across the picture has the photo on its left.
// page_proof.py writes the photos; each has the pinhole of its camera in the page.

import { element } from "./common.js";
import { STEPPING } from "./mesh.js";
import { inflated } from "./scene.js";
import { offer } from "./seen.js";

const SLIDE = 5; // percent by a key
const LINE_GRIP = 22; // half the width of the line's handle, CSS pixels

export class Compare {
  static async open(viewer) {
    const { photos } = viewer.facts;
    const bytes = await inflated(
      document.querySelectorAll("script.photos"),
      photos.reduce((sum, photo) => sum + photo.bytes, 0),
    );
    let begin = 0;
    const urls = photos.map((photo) =>
      URL.createObjectURL(new Blob([bytes.subarray(begin, (begin += photo.bytes))], { type: "image/jpeg" })),
    );
    return new Compare(
      viewer,
      photos.map(({ index }) => index),
      urls,
    );
  }

  // indices: of the photos' cameras. urls: of the photos.
  constructor(viewer, indices, urls) {
    Object.assign(this, { viewer, indices, urls, on: false, at: 0, share: 0.5, meshShare: 1 });
    const listen = (id, event, act) => element(id).addEventListener(event, act);
    offer(element("compare"));
    listen("compare", "click", () => this.toggle());
    listen("compare-close", "click", () => {
      this.toggle();
      element("compare").checkVisibility() ? element("compare").focus() : viewer.canvas.focus();
    });
    listen("compare-back", "click", () => this.step(-1));
    listen("compare-next", "click", () => this.step(1));
    listen("photo-share", "input", ({ target }) => this.split(Number(target.value) / 100));
    listen("photo-share", "keydown", (event) => STEPPING.includes(event.key) && event.stopPropagation());
    const line = element("photo-line");
    line.addEventListener("pointerdown", (event) => {
      line.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    line.addEventListener("pointermove", (event) => {
      if (!line.hasPointerCapture(event.pointerId)) return;
      const [from, to] = this.span;
      this.split((event.clientX - from) / (to - from));
    });
  }

  // Starts with the photo of the current view, or else the first one.
  toggle() {
    const { viewer } = this;
    this.on = !this.on;
    element("compare").setAttribute("aria-pressed", this.on);
    element("compare-card").hidden = !this.on;
    if (viewer.meshes && this.on) this.meshShare = viewer.meshes.share;
    viewer.meshes?.split(this.on ? 1 : this.meshShare); // one line at a time
    if (viewer.meshes) element("mesh-line").hidden = this.on;
    if (!this.on) return this.hide();
    viewer.guide?.close();
    this.go(Math.max(0, this.indices.indexOf(viewer.cameraIndex)));
  }

  step(by) {
    this.go((this.at + by + this.urls.length) % this.urls.length);
  }

  go(at) {
    this.at = at;
    this.describe();
    element("photo").src = this.urls[at];
    if (this.viewer.cameraIndex === this.indices[at]) this.place();
    else this.viewer.flyTo(this.viewer.facts.cameras[this.indices[at]], this.indices[at]);
  }

  describe() {
    const { name, held_out: heldOut } = this.viewer.facts.cameras[this.indices[this.at]];
    const use = heldOut ? "held out, not used for training" : "used for training";
    element("compare-card").querySelector("strong").textContent =
      `${name}: ${use} (${this.at + 1} of ${this.urls.length})`;
    element("photo").alt = `${name}, ${use}`;
  }

  // The view is at another camera now; at none if the index is negative.
  mark(index) {
    if (!this.on) return;
    const at = this.indices.indexOf(index);
    if (at >= 0 && at !== this.at) this.go(at);
    else this.place();
  }

  // Moves the line. Away from the photo's camera, the view returns to it first.
  split(share) {
    this.share = Math.min(1, Math.max(0, share));
    if (this.viewer.cameraIndex !== this.indices[this.at]) this.viewer.goTo(this.indices[this.at]);
    this.place();
  }

  slide(by) {
    if (this.on) this.split(this.share + (by * SLIDE) / 100);
  }

  hide() {
    element("photo").hidden = element("photo-line").hidden = true;
  }

  // Lays the photo over the picture of its camera, once that is on the screen whole.
  place() {
    const { viewer } = this;
    const index = this.indices[this.at];
    if (!this.on || !viewer.isWhole || viewer.exact || viewer.cameraIndex !== index) return this.hide();
    const [camera, shown] = [viewer.facts.cameras[index], viewer.camera()];
    const { left, top, width } = viewer.canvas.getBoundingClientRect();
    const dense = shown.W / width;
    const scale = shown.fx / camera.fx;
    const edge = (middle, own) => (middle + 0.5 - (own + 0.5) * scale) / dense;
    const [x, y] = [left + edge(shown.cx, camera.cx), top + edge(shown.cy, camera.cy)];
    const [across, down] = [(camera.W * scale) / dense, (camera.H * scale) / dense];
    this.span = [Math.max(left, x), Math.min(left + width, x + across)];
    const at = this.span[0] + this.share * (this.span[1] - this.span[0]);
    const photo = element("photo");
    const clip = `inset(0 ${Math.max(0, x + across - at)}px 0 0)`;
    Object.assign(photo.style, {
      left: `${x}px`,
      top: `${y}px`,
      width: `${across}px`,
      height: `${down}px`,
      clipPath: clip,
    });
    element("photo-line").style.left = `${Math.min(Math.max(at, left + LINE_GRIP), left + width - LINE_GRIP)}px`;
    photo.hidden = element("photo-line").hidden = false;
    const percent = Math.round(100 * this.share);
    element("photo-share").value = percent;
    element("photo-share").setAttribute("aria-valuetext", `photo ${percent} %, picture ${100 - percent} %`);
  }
}

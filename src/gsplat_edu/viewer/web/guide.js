// The guided tour: the author's named views that have a text, one after the other.

import { element } from "./common.js";
import { offer } from "./seen.js";

const SWIPE = 40; // least pixels to the side

export class Guide {
  // The tour of a page; null if no view has a text. An editor makes its own.
  static of(viewer) {
    const { cameras, edit } = viewer.facts;
    const steps = cameras
      .map((camera, index) => ({ name: camera.name, text: camera.text, camera, index }))
      .filter(({ text }) => text);
    if (edit || !steps.length) return null;
    offer(element("tour"));
    element("tour").querySelector("span").textContent = `Guided tour (${steps.length})`;
    const guide = new Guide(viewer, element("tour"), steps);
    guide.button.addEventListener("click", () => guide.toggle());
    return guide;
  }

  // button: shows whether the tour is on. steps: [{name, text, camera, index}]; the index is that of the page's cameras, or -1.
  constructor(viewer, button, steps) {
    Object.assign(this, { viewer, button, steps, on: false, at: 0, touched: null, onToggle: () => {} });
    element("guide-back").addEventListener("click", () => this.step(-1));
    element("guide-next").addEventListener("click", () => this.step(1));
    element("guide-close").addEventListener("click", () => {
      this.close();
      button.checkVisibility() ? button.focus() : viewer.canvas.focus();
    });
    const card = element("guide");
    card.addEventListener(
      "pointerdown",
      ({ pointerType, clientX }) => (this.touched = pointerType === "touch" ? clientX : null),
    );
    card.addEventListener("pointerup", ({ clientX }) => {
      const by = this.touched === null ? 0 : clientX - this.touched;
      this.touched = null;
      if (Math.abs(by) >= SWIPE) this.step(by < 0 ? 1 : -1);
    });
    card.addEventListener("pointercancel", () => (this.touched = null));
  }

  toggle() {
    if (this.on) return this.close();
    if (this.viewer.compare?.on) this.viewer.compare.toggle();
    this.on = true;
    element("guide").hidden = false;
    this.button.setAttribute("aria-pressed", true);
    this.onToggle(true);
    return this.go(0);
  }

  close() {
    if (!this.on) return;
    this.on = false;
    element("guide").hidden = true;
    this.button.setAttribute("aria-pressed", false);
    this.onToggle(false);
  }

  // The tour has a beginning and an end.
  step(by) {
    const at = this.at + by;
    if (at >= 0 && at < this.steps.length) this.go(at);
  }

  go(at) {
    this.show(at);
    const { camera, index } = this.steps[at];
    this.viewer.flyTo(camera, index);
  }

  // Shows the text of a step.
  show(at) {
    this.at = at;
    const { name, text } = this.steps[at];
    element("guide").querySelector("h2").textContent = `${at + 1}. ${name}`;
    element("guide-text").textContent = text;
    element("guide-text").scrollTop = 0;
    element("guide-step").textContent = `${at + 1} of ${this.steps.length}`;
    // aria-disabled: a disabled button would lose the focus
    element("guide-back").setAttribute("aria-disabled", at === 0);
    element("guide-next").setAttribute("aria-disabled", at === this.steps.length - 1);
  }
}

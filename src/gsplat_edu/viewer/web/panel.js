// Everything around the picture: metadata, buttons, the capture's cameras, messages.

import { element, Fold } from "./common.js";
import { h } from "./patch.js";

const POINT_SHOWN = 800; // milliseconds

export class Panel {
  // actions: fly(), reset(), goTo(index), degree(value).
  constructor(facts, actions) {
    this.facts = facts;
    if (!facts.lod) this.counted(facts.count);
    element("fly").addEventListener("click", () => actions.fly());
    element("reset").addEventListener("click", () => actions.reset());
    element("help-button").addEventListener("click", () => this.help());
    this.folded = new Fold("all"); // the picture comes first
    this.fillDegrees(actions);
    this.fillCameras(actions);
    this.atRest();
  }

  counted(count) {
    element("count").textContent = count === 1 ? "1 splat" : `${count.toLocaleString("en")} splats`;
  }

  // How many splats of a scene with levels of detail are shown.
  showing(count) {
    const all = this.facts.lod.finest.toLocaleString("en");
    element("count").textContent = `${count.toLocaleString("en")} of ${all} splats`;
  }

  fillDegrees(actions) {
    const select = element("degree");
    const most = this.facts.sh_degree;
    for (let degree = 0; degree <= most; ++degree) {
      const name = degree === 0 ? "off" : degree === most ? "full" : `${degree} of ${most}`;
      select.add(new Option(name, degree));
    }
    select.parentElement.hidden = most === 0;
    select.value = Math.min(this.facts.settings.sh_degree, this.facts.sh_degree);
    select.addEventListener("change", () => {
      actions.degree(Number(select.value));
      select.blur(); // otherwise it would keep receiving the keys
    });
  }

  // The views that the author named, and those of the photos.
  fillCameras(actions) {
    const { cameras, shared } = this.facts;
    this.buttons = cameras.map(({ name, held_out }, index) => {
      const title = "Test view: this photo was not used for training.";
      const mark = held_out && [" ", h("small", { title }, "held out")];
      return h("button", { onclick: () => actions.goTo(index) }, name, mark);
    });
    this.listed(
      "views",
      "Views",
      this.buttons.filter((_, i) => cameras[i].saved),
    );
    this.listed(
      "cameras",
      shared ? "Photos" : "Cameras",
      this.buttons.filter((_, i) => !cameras[i].saved),
    );
  }

  // Fills a list that can be closed.
  listed(id, title, buttons) {
    element(id).hidden = buttons.length === 0;
    element(id).querySelector("summary").textContent = `${title} (${buttons.length})`;
    element(id)
      .querySelector("ol")
      .append(...buttons.map((button) => h("li", {}, button)));
  }

  // Highlights the current camera; none once the view has moved away from it.
  mark(index) {
    this.buttons.forEach((button, i) => button.setAttribute("aria-current", i === index));
    this.buttons[index]?.scrollIntoView({ block: "nearest" });
  }

  flying(on) {
    element("fly").setAttribute("aria-pressed", on);
  }

  help() {
    element("help").hidden = !element("help").hidden;
  }

  rate(framesPerSecond) {
    element("rate").textContent = `${framesPerSecond.toFixed(0)} frames/s`;
  }

  // The view moves, and less than everything is drawn.
  coarse(framesPerSecond) {
    element("rate").textContent = `${framesPerSecond.toFixed(0)} frames/s, coarse`;
  }

  // The view is still, and everything is being drawn.
  completing() {
    element("rate").textContent = "drawing all ...";
  }

  // Nothing is drawn while the view is still, so there is no frame rate.
  atRest() {
    element("rate").textContent = "";
  }

  // Shows the pivot for a moment.
  point(x, y) {
    const mark = element("point");
    [mark.style.left, mark.style.top] = [`${x}px`, `${y}px`];
    mark.hidden = false;
    clearTimeout(this.pointShown);
    this.pointShown = setTimeout(() => (mark.hidden = true), POINT_SHOWN);
  }
}

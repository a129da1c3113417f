// The page that a visitor sees: title, hint and a bar of icons over the picture. Numbers and controls open from the bar.

import { element } from "./common.js";

const ALONE = 3000; // milliseconds without a move after which the picture is alone
const CLOSE_TO = [document.body, document.documentElement, null]; // has the focus if nothing else has it

export class Visitor {
  constructor(viewer) {
    this.viewer = viewer;
    for (const event of ["pointermove", "pointerdown", "keydown", "focusin", "wheel"])
      addEventListener(event, () => this.wake(), { passive: true });
    const leave = () => (element("hint").hidden = true);
    viewer.canvas.addEventListener("pointerdown", leave, { once: true });
    addEventListener("keydown", leave, { once: true });
    element("hint").textContent = matchMedia("(any-pointer: fine)").matches
      ? "Drag to look around"
      : "Drag with a finger to look around";
    element("hint").hidden = false;
    this.offerTour();
    this.offerFullScreen();
    addEventListener("hashchange", () => this.followAddress());
    this.followAddress();
    this.wake();
  }

  // The bar is there again, and goes after a rest, unless something of it is in use.
  wake() {
    document.body.classList.remove("resting");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.rest(), ALONE);
  }

  rest() {
    const focused = document.activeElement;
    const isFree = CLOSE_TO.includes(focused) || focused === this.viewer.canvas;
    if (isFree && element("tools").hidden && element("help").hidden) document.body.classList.add("resting");
    else this.wake();
  }

  offerTour() {
    const { guide } = this.viewer;
    const begin = element("begin");
    begin.hidden = !guide;
    if (!guide) return;
    begin.addEventListener("click", () => {
      guide.toggle();
      element("guide-next").focus();
    });
    const before = guide.onToggle;
    guide.onToggle = (on) => {
      before(on);
      document.body.classList.toggle("touring", on);
      if (on) [element("hint").hidden, begin.hidden] = [true, true];
      if (on && !element("tools").hidden) this.viewer.panel.folded.hide(true);
    };
  }

  offerFullScreen() {
    const button = element("full-screen");
    button.hidden = !document.fullscreenEnabled;
    button.addEventListener("click", () =>
      document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen(),
    );
    document.addEventListener("fullscreenchange", () =>
      button.setAttribute("aria-pressed", Boolean(document.fullscreenElement)),
    );
  }

  // page.html#view=2 opens the second of the author's views, or of the photos where there is none.
  followAddress() {
    const asked = /(?:^#|&)view=(\d+)/.exec(location.hash);
    if (!asked) return;
    const { cameras } = this.viewer.facts;
    const views = cameras.flatMap(({ saved }, index) => (saved ? [index] : []));
    const index = (views.length ? views : [...cameras.keys()])[asked[1] - 1];
    if (index !== undefined) this.viewer.goTo(index);
  }
}

// Shows how much of the scene is unpacked, from 0 to 1.
export function tellUnpacked(share) {
  element("unpacking").value = share;
}

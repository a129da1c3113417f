// The page of a scene, as its owner and visitors see it: title, hint and a bar of icons over the picture. Numbers and
// controls open from the bar.

import { element } from "./common.js";

const ALONE = 3000; // milliseconds without a move after which the picture is alone
const CLOSE_TO = [document.body, document.documentElement, null]; // has the focus if nothing else has it

const SHEETS = ["tools", "help"]; // above the bar, in the same place
const CARDS = ["guide", "compare-card"];

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
    const opened = new MutationObserver((changes) =>
      changes.forEach(({ target }) => target.hidden || this.closeFor(target)),
    );
    for (const id of [...SHEETS, ...CARDS]) opened.observe(element(id), { attributeFilter: ["hidden"] });
    this.offerBounds();
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
    if (isFree && SHEETS.every((id) => element(id).hidden)) document.body.classList.add("resting");
    else this.wake();
  }

  // Closes the sheets in favour of the sheet or card that has been opened.
  closeFor({ id }) {
    if (id !== "tools") this.viewer.panel.folded.hide(true);
    if (id !== "help") element("help").hidden = true;
  }

  // What no photo saw fades into the colour that most photos have at their border; a switch shows all of the scene.
  offerBounds() {
    const { viewer } = this;
    const { border, cameras, shared } = viewer.facts;
    const plain = viewer.settings.background;
    if (!shared || cameras.every(({ saved }) => saved)) return; // owners look everywhere; or there are no photos to keep to
    element("keep").hidden = false;
    const follow = () => {
      const { checked } = element("kept");
      viewer.view.bounds = checked ? "photos" : "none";
      viewer.settings.background = (checked && border) || plain;
      if (viewer.seen) viewer.renderer.seen.faded = checked ? 1 : 0;
      viewer.refresh();
    };
    element("kept").addEventListener("change", follow);
    follow();
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
      if (on) [element("hint").hidden, begin.hidden] = [true, true];
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

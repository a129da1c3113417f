// The matched points of the chosen photo: in space, on the photo, and which other photos have them too.

import { numbered } from "./capture_panel.js";
import { element, refill } from "./common.js";
import { want } from "./patch.js";
import { inflated } from "./scene.js";

const MOST_SHARING = 6; // photos in the list
const DOT = 1.5; // CSS px, radius of a matched point on the photo
const WIDEST_PLACE = 65535; // the right or lower border of a photo

// The matched points of all photos, as capture_matches.py packs them; null if the capture has none.
export async function readMatches({ matches }) {
  if (!matches) return null;
  const { points, pairs, thinned } = matches;
  const count = pairs.reduce((sum, some) => sum + some, 0);
  const { buffer } = await inflated(document.querySelectorAll("script.matches"), 12 * points + 8 * count);
  let first = 0;
  const firsts = [0, ...pairs.map((some) => (first += some))];
  return {
    thinned,
    firsts,
    positions: new Float32Array(buffer, 0, 3 * points),
    rows: new Uint32Array(buffer, 12 * points, count),
    places: new Uint16Array(buffer, 12 * points + 4 * count, 2 * count),
  };
}

export class MatchPanel {
  // matches: from readMatches. actions: choose(index), repaint().
  constructor(matches, cameras, actions) {
    Object.assign(this, { matches, cameras, actions, chosen: -1, positions: new Float32Array(0) });
    const redraw = () => this.draw();
    element("show-matches").addEventListener("change", () => actions.repaint());
    element("photo").addEventListener("load", redraw);
    new ResizeObserver(redraw).observe(element("framed"));
    matchMedia("(prefers-color-scheme: light)").addEventListener("change", redraw);
  }

  toggle() {
    element("show-matches").click();
  }

  get shown() {
    return Boolean(this.matches) && this.chosen >= 0 && element("show-matches").checked;
  }

  // The pairs of a photo, from and to.
  pairsOf(index) {
    const { firsts } = this.matches;
    return [firsts[index], firsts[index + 1]];
  }

  choose(index) {
    const isOther = index !== this.chosen;
    this.chosen = index;
    element("matches").hidden = !this.matches || index < 0;
    const rows = this.shown ? this.matches.rows.subarray(...this.pairsOf(index)) : [];
    this.positions = new Float32Array(3 * rows.length);
    rows.forEach((row, k) => this.positions.set(this.matches.positions.subarray(3 * row, 3 * row + 3), 3 * k));
    if (isOther && this.matches && index >= 0) this.list(index);
    this.draw();
  }

  // The photos that have most points in common with this one, with the number of these points.
  sharing(index) {
    const { rows, positions } = this.matches;
    const has = new Uint8Array(positions.length / 3);
    for (const row of rows.subarray(...this.pairsOf(index))) has[row] = 1;
    const found = this.cameras.list.map((_, other) => {
      let common = 0;
      if (other !== index) for (const row of rows.subarray(...this.pairsOf(other))) common += has[row];
      return { other, common };
    });
    return found.filter(({ common }) => common).sort((a, b) => b.common - a.common || a.other - b.other);
  }

  list(index) {
    const found = this.sharing(index);
    const number = numbered(found.length, "photo");
    const about = this.matches.thinned ? " (counted on a sample of the points)" : "";
    const text = found.length
      ? `Shares points with ${number}${about}; most with`
      : "Shares points with no other photo.";
    element("sharing-with").textContent = text;
    const items = found.slice(0, MOST_SHARING).map(({ other, common }) => {
      const words = [this.cameras.list[other].name, " ", want("small", {}, common.toLocaleString("en"))];
      return want("li", {}, want("button", { onclick: () => this.actions.choose(other) }, words));
    });
    refill(element("sharing"), items, element("next"));
  }

  // Draws the points over the photo, which fills its place as far as its shape allows.
  draw() {
    const [canvas, photo] = [element("dots"), element("photo")];
    const isOther = photo.alt !== this.cameras.list[this.chosen]?.name; // the chosen one is still on its way
    canvas.hidden = !this.shown || photo.hidden || !photo.naturalWidth || isOther;
    if (canvas.hidden) return;
    const { clientWidth: width, clientHeight: height } = photo;
    const dense = window.devicePixelRatio || 1;
    Object.assign(canvas, { width: Math.round(width * dense), height: Math.round(height * dense) });
    Object.assign(canvas.style, { top: `${photo.offsetTop}px`, height: `${height}px` });
    const context = canvas.getContext("2d");
    context.scale(dense, dense);
    const scale = Math.min(width / photo.naturalWidth, height / photo.naturalHeight);
    const [w, h] = [scale * photo.naturalWidth, scale * photo.naturalHeight];
    context.fillStyle = getComputedStyle(document.body).getPropertyValue("--match");
    const [from, to] = this.pairsOf(this.chosen);
    for (let k = from; k < to; ++k) {
      const [x, y] = [this.matches.places[2 * k], this.matches.places[2 * k + 1]].map((place) => place / WIDEST_PLACE);
      context.beginPath();
      context.arc((width - w) / 2 + w * x, (height - h) / 2 + h * y, DOT, 0, 2 * Math.PI);
      context.fill();
    }
  }
}

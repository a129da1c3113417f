// Shows a training: its state, as often as the server tells it, and its newest splats, whenever the last ones are drawn.

import { element, fail, say } from "./common.js";
import { Renderer } from "./draw.js";
import { FACTS } from "./facts.js";
import { Curve } from "./live_curves.js";
import { h, patch, want } from "./patch.js";
import { arraysIn } from "./scene.js";

// Drawing other splats takes this computer's time, which the training needs as well. So the page waits this many times
// as long as it worked before it asks for the next ones.
const REST_FACTOR = 20;
const SHORTEST_REST = 500; // milliseconds
const LONGEST_REST = 30000;
const PHOTOS_VARY = 0.25; // weight of the newest photo in the curves of its loss and PSNR
const TRIES = 4; // to reach the server again before the page gives up
const TRY_EVERY = 1000; // milliseconds

const whole = (number) => number.toLocaleString("en");

function duration(seconds) {
  const [hours, minutes] = [Math.floor(seconds / 3600), Math.floor(seconds / 60) % 60];
  if (hours) return `${hours} h ${minutes} min`;
  return minutes ? `${minutes} min ${Math.floor(seconds) % 60} s` : `${Math.ceil(seconds)} s`;
}

// The header and the splats of scene.bin; live_folder.py describes it.
function unframed(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { header, splats: arraysIn(buffer, 4 + length, header) };
}

// In the studio, the screen around the page has the one counter, clock and curves, and the buttons.
const INSIDE = window.parent !== window;
if (INSIDE) document.documentElement.classList.add("inside");

class Live {
  constructor(viewer, { step }) {
    Object.assign(this, { viewer, state: null, over: false, wake: () => {}, steps: step });
    this.draws = viewer.renderer instanceof Renderer;
    viewer.isTraining = this.draws; // until a state tells otherwise
    this.build();
    history.replaceState(null, "", location.pathname); // without the token
    this.watch();
    if (this.draws) this.follow().catch(fail);
  }

  build() {
    this.title = h("p", { class: "state", role: "status" }, "waiting for the first iteration");
    this.bar = h("progress", { max: 1, value: 0, "aria-label": "iterations" });
    this.left = h("p", { class: "left" }, "\u00a0");
    this.photos = h("p", { title: "Size that is trained on, and its share of the full width" }, "\u00a0");
    this.curves = {
      loss: new Curve("loss", (value) => value.toPrecision(3), PHOTOS_VARY),
      psnr: new Curve("PSNR", (value) => `${value.toFixed(2)} dB`, PHOTOS_VARY),
      count: new Curve("splats", whole, 1),
    };
    this.note = h("p", { class: "note", role: "alert", hidden: "" });
    this.buttons = h("p", { class: "row" });
    this.offer("pause");
    const curves = Object.values(this.curves).map((curve) => curve.element);
    const section = h("section", { id: "live", "aria-label": "training" });
    section.append(this.title, this.bar, this.left, this.buttons, this.note);
    element("tools").before(section);
    element("tools").prepend(h("section", { id: "curves", "aria-label": "curves" }, ...curves, this.photos));
    this.noted(this.draws ? "" : "This browser has no WebGL2, so the training's computer draws the pictures.");
  }

  // Shows the buttons. What the first one does is what it said when it was pressed.
  offer(what, disabled = false) {
    const button = (text, more) =>
      want("button", { disabled, onclick: () => this.control(text), ...more }, text[0].toUpperCase() + text.slice(1));
    patch(
      this.buttons,
      button(what, { title: "Wait after this iteration, or continue" }),
      button("step", { title: "One more iteration, then wait", hidden: !this.steps }),
    );
  }

  noted(text) {
    this.note.textContent = text;
    this.note.hidden = !text;
  }

  async control(what) {
    await fetch("control", { method: "POST", body: JSON.stringify({ do: what }) }).catch(() => {});
  }

  // Shows states until the server is gone.
  async watch() {
    let [version, failures] = [-1, 0];
    while (failures < TRIES) {
      try {
        const answer = await fetch(`state?after=${version}&quiet=1`);
        if (!answer.ok) throw new Error(answer.statusText);
        if (answer.status === 204) {
          failures = 0;
          continue;
        }
        const state = await answer.json();
        if (state.error) throw new Error(state.error);
        [version, failures] = [state.version, 0];
        this.show(state);
      } catch {
        ++failures;
        await new Promise((resolve) => setTimeout(resolve, TRY_EVERY));
      }
    }
    this.over = true;
    this.spare(false);
    this.wake();
    this.title.textContent = "ended";
    this.offer(this.state?.state === "paused" ? "resume" : "pause", true);
    this.noted("The training's program has ended or cannot be reached. This is the last scene that the page received.");
  }

  show(state) {
    this.state = state;
    const { iteration, iterations, history, seconds_left: left } = state;
    this.title.textContent = `${state.state}, iteration ${whole(iteration)} of ${whole(iterations)}`;
    [this.bar.max, this.bar.value] = [iterations, iteration];
    this.left.textContent = left === null ? "\u00a0" : `${duration(left)} left`;
    const share = state.photo_factor === 1 ? "" : ` (1/${Number(state.photo_factor.toFixed(2))})`;
    this.photos.textContent = state.width ? `photos of ${state.width} × ${state.height} px${share}` : "\u00a0";
    for (const [name, curve] of Object.entries(this.curves)) curve.show(state[name], history.iteration, history[name]);
    this.offer(state.state === "paused" ? "resume" : "pause", !["training", "paused"].includes(state.state));
    const still = ["paused", "finished"].includes(state.state);
    this.spare(!still);
    if (state.failure || this.draws) this.noted(state.failure);
    if (still) this.wake();
    if (this.draws) return;
    this.viewer.renderer.still = still;
    this.viewer.panel.counted(state.count);
    if (this.viewer.renderer.failure) this.noted(this.viewer.renderer.failure);
    if (iteration !== this.pictured) this.viewer.askFrame();
    this.pictured = iteration;
  }

  // While the training needs the processor, a slow page draws less; afterwards, it completes its picture.
  spare(isTraining) {
    const { viewer } = this;
    const before = viewer.isTraining;
    viewer.isTraining = isTraining;
    if (before && !isTraining && viewer.pace.slow) viewer.askFrame();
  }

  // Draws the newest splats until the server is gone.
  async follow() {
    let iteration = -1;
    say("Waiting for the first splats ...");
    while (!this.over) {
      await this.visible();
      const answer = await fetch(`scene?after=${iteration}&quiet=1`).catch(() => null);
      const refused = !answer?.ok || answer.headers.get("content-type")?.startsWith("application/json");
      if (refused || answer.status === 204) {
        if (refused) await this.rest(TRY_EVERY);
        continue;
      }
      const began = performance.now();
      const buffer = await answer.arrayBuffer().catch(() => null);
      if (!buffer) continue; // the server ended
      const { header, splats } = unframed(buffer);
      await this.viewer.replace({ count: header.count, sh_degree: header.sh_degree }, splats);
      await this.viewer.renderer.drawn();
      iteration = header.iteration;
      say("");
      if (!INSIDE) element("count").textContent += ` after ${whole(iteration)} iterations`;
      const spent = performance.now() - began;
      await this.rest(Math.min(LONGEST_REST, Math.max(SHORTEST_REST, REST_FACTOR * spent)));
    }
  }

  // Resolves once somebody can see the page.
  async visible() {
    while (document.hidden) {
      await new Promise((resolve) => document.addEventListener("visibilitychange", resolve, { once: true }));
    }
  }

  // Waits; not for long if the training waits as well.
  rest(milliseconds) {
    const still = ["paused", "finished"].includes(this.state?.state);
    return new Promise((resolve) => {
      this.wake = resolve;
      setTimeout(resolve, still ? SHORTEST_REST : milliseconds);
    });
  }
}

addEventListener("viewer", ({ detail }) => (window.live = new Live(detail.viewer, FACTS.live)));

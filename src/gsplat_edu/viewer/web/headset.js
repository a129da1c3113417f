// The scene in a headset (WebXR): a button starts a session where the browser has one, in which both eyes see the scene.

import { element, fail, say } from "./common.js";
import { offer } from "./seen.js";
import { plus } from "./vectors.js";
import { eyeCamera, headOf, metreOf, placed, Push, pushes, standAt, turnedStand, wayOf } from "./xr.js";

const MODE = "immersive-vr";
const SHARE = 0.5; // of the headset's pixels on each side: what splats cost is mostly by pixel
const MOST_DRAWN = 500000; // splats: gsplat-unity draws so many 72 times per second on a Quest 3
const LONGEST_GLIDE = 0.1; // seconds that one frame moves, however long it took
const REFUSED =
  "VR did not start. Check that the headset is on, let this page use it if the browser asks, and press VR again.";

const STEPS_PREFERRED = matchMedia("(prefers-reduced-motion: reduce)"); // no gliding

export class Headset {
  // Shows the button if there is a headset. Resolves once that is known.
  static async look(viewer) {
    if (!navigator.xr || !viewer.renderer.gl) return;
    // a page in a frame that may not use headsets gets an error
    const found = await navigator.xr.isSessionSupported(MODE).catch(() => false);
    if (found) viewer.headset = new Headset(viewer);
  }

  constructor(viewer) {
    Object.assign(this, { viewer, session: null, asking: false, eye: null });
    offer(element("vr"));
    element("vr").addEventListener("click", () => this.toggle());
  }

  async toggle() {
    if (this.session) return this.end();
    if (this.asking || this.viewer.lost) return undefined;
    this.asking = true;
    await this.start();
    this.asking = false;
    return undefined;
  }

  async start() {
    const { gl } = this.viewer.renderer;
    let session = null;
    try {
      session = await navigator.xr.requestSession(MODE);
      await gl.makeXRCompatible();
      const layer = { alpha: false, antialias: false, depth: false, framebufferScaleFactor: SHARE };
      session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl, layer) });
      this.begin(session, await session.requestReferenceSpace("local")); // every headset has this space
    } catch {
      if (!this.viewer.lost) tell(REFUSED); // else that is said
      await session?.end().catch(() => {}); // it may have ended by itself, which was the reason
    }
  }

  begin(session, space) {
    const { viewer } = this;
    viewer.stop();
    cancelAnimationFrame(viewer.frameAsked);
    viewer.frameAsked = 0;
    viewer.isWhole = false;
    Object.assign(this, {
      session,
      space,
      stand: null,
      last: 0,
      isSorted: false,
      turning: new Push(),
      moving: new Push(),
    });
    element("vr").setAttribute("aria-pressed", true);
    session.addEventListener("end", () => this.ended());
    space.addEventListener("reset", () => (this.stand = null)); // the scene is in front again
    session.requestAnimationFrame((now, frame) => this.frame(now, frame));
  }

  // Ends the session, if there is one that has not just ended by itself.
  end() {
    return this.session?.end().catch(() => {});
  }

  // The page draws again.
  ended() {
    this.session = null;
    element("vr").setAttribute("aria-pressed", false);
    this.viewer.refresh();
  }

  frame(now, frame) {
    const { session, viewer } = this;
    session.requestAnimationFrame((...next) => this.frame(...next));
    const pose = frame.getViewerPose(this.space);
    if (!pose) return; // the headset does not know where it is
    const head = headOf(pose.transform.matrix);
    const { facts, view } = viewer;
    this.stand ??= standAt(view.camera, view.up, head, metreOf(facts.unit, view.distance));
    this.steer(head, Math.min((now - (this.last || now)) / 1000, LONGEST_GLIDE));
    this.last = now;
    this.eye = placed(this.stand, head.at);
    this.sort(this.eye);
    for (const eye of pose.views) this.draw(eye);
  }

  // Turns and moves as the sticks say, as softly bounded as on the page.
  steer(head, seconds) {
    const { turn, move } = pushes(this.session.inputSources);
    if (this.turning.begins(Math.abs(turn))) this.stand = turnedStand(this.stand, head, Math.sign(turn));
    const isStep = this.moving.begins(Math.hypot(...move));
    const way = wayOf(this.stand, head, move, STEPS_PREFERRED.matches ? { isStep } : { seconds });
    const from = placed(this.stand, head.at);
    const share = this.viewer.view.share(plus(from, way), from);
    this.stand = { ...this.stand, origin: plus(this.stand.origin, way, share) };
  }

  // Asks for another order if the head has moved. It is by distance from the head: both eyes share it, and turning the head
  // leaves it as it is.
  sort(eye) {
    const { viewer } = this;
    const { sorter, pace } = viewer;
    const most = Math.min(MOST_DRAWN, pace.detail.most);
    const head = { eye, R: null };
    this.isSorted = sorter.fits(head, most);
    if (!sorter.running && !this.isSorted) sorter.sort(head, most).then(() => viewer.askFrame(), fail);
  }

  // Draws the picture of an eye.
  draw(view) {
    const { renderer, settings } = this.viewer;
    const { baseLayer } = this.session.renderState;
    const { x, y, width, height } = baseLayer.getViewport(view);
    if (!width || !height) return; // a screen shows one eye only
    renderer.draw(eyeCamera(this.stand, view.transform.matrix, view.projectionMatrix, { width, height }), settings);
    renderer.show({ framebuffer: baseLayer.framebuffer, x, y, width, height });
  }
}

// Shows a message until something is pressed.
function tell(text) {
  say(text);
  const pressed = new AbortController();
  const leave = () => {
    pressed.abort();
    if (element("message").textContent === text) say("");
  };
  for (const event of ["pointerdown", "keydown"]) addEventListener(event, leave, { signal: pressed.signal });
}

// Moves the view by mouse, touch and keyboard.

const WHEEL = 0.0015; // logarithm of the distance per pixel of scrolling
const LINE = 16; // pixels per line, for wheels that count lines
const PINCH = 8; // a pinch on a touchpad arrives as a slow wheel with Ctrl
const PACE = 0.5; // initial distances per second
const HURRY = 4; // factor with Shift
const TAP = 10; // most pixels that a finger moves in a tap
const TAP_PAUSE = 400; // most milliseconds between the taps of a double tap
const TAP_APART = 30; // most pixels between them

// Along (right, down, forward).
const STEPS = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyQ: [0, 1, 0],
  KeyE: [0, -1, 0],
};

// Orbits to the right and down: arrows with Shift, and without it where a page has no other use for the arrow.
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const TURN = 0.8; // radians per second
const NUDGE = 0.03; // radians at once, so that a short press is seen

const ONCE = ["f", "h", "k", "p", "t", "c", "v", "x"]; // keys that act once, however long they are held

// In a document that shows the page as a figure (scene.html#embedded), wheel and vertical drags scroll that document
// until the canvas has the focus.
const EMBEDDED = location.hash === "#embedded";
if (EMBEDDED) document.documentElement.classList.add("embedded");

export class Controls {
  // actions: moved() after every move, awake() when a held key starts to move, shown() for the camera on the screen,
  // orbitAround(x, y) for a double click or tap, and the keys' actions: fly(), reset(), help(), step(by), saveView(),
  // playPath(), guide(), compare(), seen(), headset(), slide(by), dismiss(). `cameras` is how many cameras the horizontal arrows
  // step through.
  constructor(canvas, view, actions, cameras = 0) {
    Object.assign(this, {
      canvas,
      view,
      actions,
      cameras,
      flying: false,
      pointers: new Map(),
      held: new Set(),
      hurried: false,
    });
    this.lastTap = null;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    addEventListener("keydown", (event) => this.keyDown(event));
    addEventListener("keyup", (event) => this.keyUp(event));
    addEventListener("blur", () => this.held.clear()); // a page does not see keys released elsewhere
  }

  press(event) {
    this.canvas.focus({ preventScroll: true }); // a page around this one stays where it is
    this.canvas.setPointerCapture(event.pointerId);
    const pans = event.button !== 0 || event.shiftKey;
    const [x, y] = [event.clientX, event.clientY];
    this.pointers.set(event.pointerId, { x, y, pans, taps: !pans && !this.pointers.size, began: { x, y } });
    event.preventDefault();
  }

  release(event) {
    const pointer = this.pointers.get(event.pointerId);
    this.pointers.delete(event.pointerId);
    if (pointer?.taps && !this.pointers.size) this.tap(event);
    else this.lastTap = null;
  }

  // Records a click or tap and acts on the second of two. Some browsers send no double click for fingers.
  tap({ clientX: x, clientY: y, timeStamp }) {
    const last = this.lastTap;
    const isSecond = last && timeStamp - last.timeStamp < TAP_PAUSE && Math.hypot(x - last.x, y - last.y) < TAP_APART;
    this.lastTap = isSecond ? null : { x, y, timeStamp };
    if (isSecond) this.actions.orbitAround(x, y);
  }

  drag(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    const before = this.grip();
    [pointer.x, pointer.y] = [event.clientX, event.clientY];
    if (Math.hypot(pointer.x - pointer.began.x, pointer.y - pointer.began.y) > TAP) pointer.taps = false;
    const after = this.grip();
    const [dx, dy] = [after.x - before.x, after.y - before.y];
    if (this.pointers.size > 1 || pointer.pans) this.pan(dx, dy);
    else this.turn(dx, dy);
    if (before.span && after.span) this.zoom(before.span / after.span);
    this.actions.moved();
  }

  // Midpoint of the fingers, and the distance between two.
  grip() {
    const [a, b = a] = this.pointers.values();
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, span: Math.hypot(a.x - b.x, a.y - b.y) };
  }

  turn(dx, dy) {
    const angle =
      (this.flying ? Math.PI : this.view.turn) / Math.max(this.canvas.clientWidth, this.canvas.clientHeight);
    if (this.flying) this.view.look(dx * angle, dy * angle);
    else this.view.orbit(dx * angle, dy * angle);
  }

  pan(dx, dy) {
    const dense = this.canvas.width / this.canvas.clientWidth;
    this.view.pan(dx * dense, dy * dense, this.actions.shown());
  }

  wheel(event) {
    if (EMBEDDED && document.activeElement !== this.canvas) return;
    event.preventDefault();
    const units = [1, LINE, this.canvas.clientHeight][event.deltaMode] * (event.ctrlKey ? PINCH : 1);
    this.zoom(Math.exp(WHEEL * units * event.deltaY));
    this.actions.moved();
  }

  // While flying, the pivot ahead does not limit the motion.
  zoom(factor) {
    if (this.flying) this.view.move([0, 0, (1 - factor) * this.view.distance]);
    else this.view.zoom(factor);
  }

  keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    this.hurried = event.shiftKey;
    const action = {
      f: () => this.actions.fly(),
      r: () => this.actions.reset(),
      h: () => this.actions.help(),
      k: () => this.actions.saveView(),
      p: () => this.actions.playPath(),
      t: () => this.actions.guide?.(),
      c: () => this.actions.compare?.(),
      v: () => this.actions.seen?.(),
      x: () => this.actions.headset?.(),
      ",": () => this.actions.slide?.(-1),
      ".": () => this.actions.slide?.(1),
      escape: () => this.actions.dismiss?.(),
      arrowleft: () => this.actions.step(-1),
      arrowright: () => this.actions.step(1),
    }[event.key.toLowerCase()];
    if (event.code in STEPS) {
      this.held.add(event.code);
      this.actions.awake();
    } else if (this.turnsBy(event)) {
      if (!event.repeat) this.orbit(event.code, NUDGE);
      this.held.add(event.code);
      this.actions.moved();
    } else if (action) {
      if (!event.repeat || !ONCE.includes(event.key.toLowerCase())) action();
    } else return;
    event.preventDefault();
  }

  keyUp(event) {
    this.hurried = event.shiftKey;
    this.held.delete(event.code);
  }

  // In the panel, arrows scroll lists and change numbers.
  turnsBy({ code, shiftKey, target }) {
    if (target !== this.canvas && target !== document.body) return false;
    return code in TURNS && (shiftKey || !TURNS[code][0] || !this.cameras);
  }

  orbit(code, angle) {
    const [right, down] = TURNS[code].map((sign) => sign * angle);
    if (this.flying) this.view.look(right, down);
    else this.view.orbit(right, down);
  }

  // Moves according to the held keys; returns whether any is held.
  advance(seconds) {
    const length = PACE * this.view.pace * seconds * (this.hurried ? HURRY : 1);
    for (const code of this.held) {
      if (code in TURNS) this.orbit(code, TURN * seconds);
      else this.view.move(STEPS[code].map((step) => step * length));
    }
    return this.held.size > 0;
  }
}

// The camera path of the page: views that the user saves, or the path that came with the page.

import { element, icon, refill } from "./common.js";
import { want } from "./patch.js";
import { PathCurve } from "./path.js";
import { appended, grown } from "./path_edits.js";
import { Timeline } from "./timeline.js";
import { plus, radians, transposed } from "./vectors.js";

export class Keyframes {
  // actions: view() for the current camera, goToView(camera), playPath() to start or stop, pathChanged().
  constructor(facts, actions) {
    Object.assign(this, { facts, actions });
    const { loop, duration = null, ease = null, keyframes } = facts.path ?? { loop: false, keyframes: [] };
    // a visitor removes none of the author's views
    this.path = {
      loop,
      duration,
      ease,
      keyframes: keyframes.map((entry) => ({ ...readKeyframe(entry), given: Boolean(facts.shared) })),
    };
    this.timeline = new Timeline(this);
    element("save-view").addEventListener("click", () => this.save());
    element("play").addEventListener("click", () => actions.playPath());
    element("download-path").addEventListener("click", () => this.download());
    element("loop").addEventListener("change", (event) => this.edited({ loop: event.target.checked }));
    this.list();
  }

  // Appends the current view.
  save() {
    this.set(appended(this.path, this.current()));
    element("path").open = true;
  }

  // The current view as a keyframe without a time.
  current() {
    const { R, eye, H, fy } = this.actions.view();
    return { R, eye, fov: (2 * Math.atan((0.5 * H) / fy) * 180) / Math.PI };
  }

  remove(index) {
    const kept = this.path.keyframes.filter((_, i) => i !== index);
    // one keyframe has no time between it and another
    this.edited({ keyframes: kept.length > 1 ? kept : kept.map(({ time, hold, ...view }) => view) });
    // the button is gone; the next one gets the keyboard's focus
    const buttons = element("path").querySelectorAll("li button:last-child");
    (buttons[Math.min(index, buttons.length - 1)] ?? element("save-view")).focus();
  }

  edited(changes) {
    this.set(grown(this.path, changes));
  }

  set(path) {
    this.path = path;
    this.actions.pathChanged();
    this.list();
  }

  get playable() {
    return this.path.keyframes.length > 1;
  }

  curve() {
    return new PathCurve(this.path);
  }

  // The page's camera at a pose of the path; the principal point is the centre of the image.
  camera({ R, eye, fov }) {
    const { W, H } = this.facts.start.camera;
    const f = (0.5 * H) / Math.tan(radians(fov) / 2);
    return { R, eye, fx: f, fy: f, cx: (W - 1) / 2, cy: (H - 1) / 2, W, H };
  }

  // The content of the file that `gsplat-edu render --path` reads, in the coordinates of the scene's file.
  document() {
    const { loop, duration, ease, keyframes } = this.path;
    return {
      format: "gsplat_edu path",
      version: 1,
      loop,
      ...(ease ? { ease } : {}),
      ...(duration === null ? {} : { duration }),
      keyframes: keyframes.map(({ R, eye, fov, time, hold }) => ({
        position: plus(eye, this.facts.origin),
        rotation: transposed(R),
        fov,
        ...(time === undefined ? {} : { time }),
        ...(hold ? { hold } : {}),
      })),
    };
  }

  download() {
    const text = `${JSON.stringify(this.document(), null, 2)}\n`;
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
    link.download = `${this.facts.title}.path.json`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000); // the browser may still be reading
  }

  list() {
    const { loop, keyframes } = this.path;
    element("path").querySelector("summary").textContent = `Camera path (${keyframes.length})`;
    element("loop").checked = loop;
    for (const name of ["play", "download-path"]) element(name).disabled = !this.playable;
    const button = (shown, label, onclick) => want("button", { "aria-label": label, onclick }, shown);
    const items = keyframes.map((keyframe, i) => {
      const goTo = () => this.actions.goToView(this.camera(keyframe));
      return want(
        "li",
        {},
        button(`view ${i + 1}`, `go to view ${i + 1}`, goTo),
        !keyframe.given && button(icon("#icon-close"), `remove view ${i + 1}`, () => this.remove(i)),
      );
    });
    refill(element("path").querySelector("ol"), items, element("save-view"));
    this.timeline.changed();
  }

  playing(on) {
    element("play").setAttribute("aria-pressed", on);
  }
}

export function readKeyframe({ position, rotation, fov, time, hold }) {
  return { eye: position, R: transposed(rotation), fov, time, hold };
}

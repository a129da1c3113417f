// The camera path of the page: views that the user saves, or the path that came with the page.
"use strict";

class Keyframes {
  // actions: view() for the current camera, goToView(camera), playPath() to start or stop, pathChanged().
  constructor(facts, actions) {
    Object.assign(this, { facts, actions });
    const { loop, duration = null, keyframes } = facts.path ?? { loop: false, keyframes: [] };
    this.path = { loop, duration, keyframes: keyframes.map(readKeyframe) };
    element("save-view").addEventListener("click", () => this.save());
    element("play").addEventListener("click", () => actions.playPath());
    element("download-path").addEventListener("click", () => this.download());
    element("loop").addEventListener("change", (event) => this.edited({ loop: event.target.checked }));
    this.list();
  }

  // Appends the current view. On a path with times, it follows after the mean time between the others.
  save() {
    const { keyframes } = this.path;
    const { R, eye, H, fy } = this.actions.view();
    const view = { R, eye, fov: (2 * Math.atan((0.5 * H) / fy) * 180) / Math.PI };
    const [first, last] = [keyframes[0], keyframes[keyframes.length - 1]];
    if (last?.time !== undefined) view.time = last.time + (last.time - first.time) / (keyframes.length - 1);
    this.edited({ keyframes: [...keyframes, view] });
    element("path").open = true;
  }

  remove(index) {
    const kept = this.path.keyframes.filter((_, i) => i !== index);
    // one keyframe has no time between it and another
    this.edited({ keyframes: kept.length > 1 ? kept : kept.map(({ R, eye, fov }) => ({ R, eye, fov })) });
    // the button is gone; the next one gets the keyboard's focus
    const buttons = element("path").querySelectorAll("li button:last-child");
    (buttons[Math.min(index, buttons.length - 1)] ?? element("save-view")).focus();
  }

  // After a change, a path lasts as long as its keyframes' times say, or as usual; a loop with times needs time for the
  // way back.
  edited(changes) {
    this.path = { ...this.path, ...changes, duration: null };
    const { loop, keyframes } = this.path;
    const [first, last] = [keyframes[0], keyframes[keyframes.length - 1]];
    if (loop && last?.time !== undefined) {
      const span = last.time - first.time;
      this.path.duration = span + span / (keyframes.length - 1);
    }
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
    const { loop, duration, keyframes } = this.path;
    return {
      format: "gsplat_edu path",
      version: 1,
      loop,
      ...(duration === null ? {} : { duration }),
      keyframes: keyframes.map(({ R, eye, fov, time }) => ({
        position: plus(eye, this.facts.origin),
        rotation: transposed(R),
        fov,
        ...(time === undefined ? {} : { time }),
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
    element("path").querySelector("summary").textContent = `camera path (${keyframes.length})`;
    element("loop").checked = loop;
    for (const name of ["play", "download-path"]) element(name).disabled = !this.playable;
    const button = (text, label, action) => {
      const made = document.createElement("button");
      made.textContent = text;
      made.setAttribute("aria-label", label);
      made.addEventListener("click", action);
      return made;
    };
    const items = keyframes.map((keyframe, i) => {
      const item = document.createElement("li");
      const goTo = () => this.actions.goToView(this.camera(keyframe));
      item.append(button(`view ${i + 1}`, `go to view ${i + 1}`, goTo));
      item.append(button("×", `remove view ${i + 1}`, () => this.remove(i)));
      return item;
    });
    element("path").querySelector("ol").replaceChildren(...items);
  }

  playing(on) {
    element("play").setAttribute("aria-pressed", on);
  }
}

const transposed = (rows) => [0, 1, 2].map((i) => rows.map((row) => row[i]));

function readKeyframe({ position, rotation, fov, time }) {
  return { eye: position, R: transposed(rotation), fov, time };
}

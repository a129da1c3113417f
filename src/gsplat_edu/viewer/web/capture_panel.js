// Everything around the picture of a capture: the legend, the list of photos, the chosen photo, and the one under the pointer.

import { element, Fold } from "./common.js";
import { h, patch, want } from "./patch.js";

export const SMALL = "(max-width: 600px)"; // as in capture.css
const HOVER_APART = 16; // CSS px between the pointer and the photo beside it
const NOT_THERE = "cannot be shown";

export class CapturePanel {
  // actions: choose(index), step(by), look(), leave(), size(factor), reset(), repaint().
  constructor(facts, cameras, photos, actions) {
    Object.assign(this, { facts, cameras, photos, actions, asked: 0, hovered: -1 });
    const { count, all_points: all } = facts;
    const points =
      count < all
        ? `${count.toLocaleString("en")} of ${all.toLocaleString("en")} points`
        : `${count.toLocaleString("en")} points`;
    element("count").textContent = `${numbered(cameras.list.length, "photo")}, ${count ? points : "no points"}`;
    element("gap").textContent = facts.gap_sentence;
    element("show-points").parentElement.hidden = !count;
    const pressed = { reset: "reset", close: "close", look: "look", leave: "leave" };
    for (const [id, action] of Object.entries(pressed)) element(id).addEventListener("click", () => actions[action]());
    element("previous").addEventListener("click", () => actions.step(-1));
    element("next").addEventListener("click", () => actions.step(1));
    element("help-button").addEventListener("click", () => this.help());
    for (const id of ["show-points", "show-path"]) element(id).addEventListener("change", () => actions.repaint());
    element("size").addEventListener("input", ({ target }) => actions.size(2 ** (Number(target.value) / 5)));
    element("size").addEventListener("keydown", (event) => event.stopPropagation()); // arrows move the slider only
    this.folded = new Fold("(max-width: 800px)"); // the stage of the studio is narrower, too
    this.fillList();
    this.tell();
  }

  help() {
    element("help").hidden = !element("help").hidden;
  }

  // How much of the window the closed panel covers at the top, CSS px.
  covered() {
    if (!matchMedia(SMALL).matches) return 0;
    const { top } = element("panel").getBoundingClientRect();
    return element("count").getBoundingClientRect().bottom + 2 * top;
  }

  get showsPoints() {
    return element("show-points").checked;
  }

  get showsPath() {
    return element("show-path").checked;
  }

  fillList() {
    this.buttons = this.cameras.list.map(({ name }, index) => {
      return h("button", { onclick: () => this.actions.choose(index) }, name, " ", h("small"));
    });
    element("cameras").querySelector("summary").textContent = `Photos (${this.buttons.length})`;
    patch(
      element("cameras").querySelector("ol"),
      this.buttons.map((button) => want("li", {}, button)),
    );
  }

  // What is known of each photo has changed.
  tell() {
    this.cameras.list.forEach((camera, i) => {
      this.buttons[i].querySelector("small").textContent = [
        ...(camera.left_out ? ["left out"] : []),
        ...camera.marks,
      ].join(", ");
    });
    const items = this.cameras
      .kinds()
      .map(({ kind, name, cameras }) =>
        want("li", { class: kind }, kind === "camera" ? numbered(cameras, "photo") : `${name} (${cameras})`),
      );
    patch(element("legend"), items);
    if (this.cameras.chosen >= 0) this.describe(this.cameras.list[this.cameras.chosen]);
  }

  // What the doctor is doing; empty if there is nothing to say.
  doctor(text) {
    element("doctor").textContent = text;
    element("doctor").hidden = !text;
  }

  say(text) {
    element("said").textContent = text;
  }

  // Shows a camera's photo at the side; -1 closes it.
  async choose(index) {
    this.buttons.forEach((button, i) => button.setAttribute("aria-current", i === index));
    element("chosen").hidden = index < 0;
    element("trouble").hidden = true;
    const asked = ++this.asked;
    if (index < 0) return;
    const camera = this.cameras.list[index];
    this.buttons[index].scrollIntoView({ block: "nearest" });
    this.describe(camera);
    try {
      const address = await this.photos.load(camera.photo, 512);
      await decodedPhoto(address); // it takes its place at once
      if (asked !== this.asked) return;
      element("photo").src = address;
      element("photo").alt = camera.name;
      element("photo").hidden = false;
    } catch (error) {
      if (asked !== this.asked) return;
      element("photo").hidden = true;
      this.trouble(error.message);
    }
  }

  trouble(text) {
    element("trouble").textContent = text;
    element("trouble").hidden = !text;
  }

  describe(camera) {
    const { name, points, marks, left_out: out } = camera;
    element("chosen").querySelector("h2").textContent = name;
    const parts = points === null ? [] : [`${points.toLocaleString("en")} matched points`];
    parts.push(`${camera.W} × ${camera.H} px`, ...marks, ...(out ? ["left out"] : []));
    element("facts-of").textContent = parts.join(" · ");
    element("leave").textContent = out ? "Use again" : "Leave out";
  }

  // Shows the photo of the camera under the pointer beside it; -1 hides it.
  async hover(index, x, y) {
    const box = element("hover");
    const [width, height] = [180, 190];
    box.style.left = `${x + HOVER_APART + width < innerWidth ? x + HOVER_APART : Math.max(0, x - HOVER_APART - width)}px`;
    box.style.top = `${Math.max(0, Math.min(y + HOVER_APART, innerHeight - height))}px`;
    if (index === this.hovered) return;
    this.hovered = index;
    box.hidden = index < 0;
    if (index < 0) return;
    const { name, photo, marks, left_out: out } = this.cameras.list[index];
    const caption = (more) =>
      (box.querySelector("figcaption").textContent = [name, ...(out ? ["left out"] : []), ...marks, ...more].join(
        " · ",
      ));
    caption([]);
    const picture = box.querySelector("img");
    picture.hidden = true;
    try {
      const address = await this.photos.load(photo, 256);
      if (this.hovered !== index) return;
      picture.src = address;
      picture.hidden = false;
    } catch {
      if (this.hovered === index) caption([NOT_THERE]);
    }
  }
}

// A photo in memory, ready to be shown.
async function decodedPhoto(address) {
  const picture = new Image();
  picture.src = address;
  await picture.decode();
  return picture;
}

export const numbered = (count, word) => `${count.toLocaleString("en")} ${word}${count === 1 ? "" : "s"}`;

// Tells the page around this one, if it is from the same server, by an event of the frame: "started", or "left" with the
// photo that was left out or taken back here.
export function tellFrame(name, detail = {}) {
  window.frameElement?.dispatchEvent(new CustomEvent(name, { detail }));
}

// Our page of a scene in a frame, and a photo laid over the same view.

import { at, get, head } from "./api.js";
import { picture } from "./covers.js";
import { button, h, patch, put, want } from "./dom.js";

const RETRY = 3000; // milliseconds until a page that is not there yet is asked for again
const LOOK = 250; // milliseconds between two looks at what the frame shows
const GLANCE = 50; // milliseconds between two looks at whether a chosen view is drawn
const MOST_SIDE = 1024; // px of a picture beside a photo

// A frame that shows a page as soon as the server has it; until then, what it showed before, or at first the picture of an
// entry.
export function frame(title) {
  const inner = h("iframe", { title, allow: "fullscreen; clipboard-write", hidden: true });
  const message = h("p", { class: "message", role: "status" }, "Loading the scene ...");
  const cover = h("img", { class: "cover", alt: "", hidden: true });
  const photo = h("img", { class: "over-photo", alt: "", hidden: true });
  const full = button("Full screen", () => element.requestFullscreen?.());
  const element = h("div", { class: "scene" }, inner, cover, photo, message);
  element.image = cover;
  let [address, timer, looks] = [null, 0, 0];

  async function open() {
    clearTimeout(timer);
    const wanted = address;
    if (wanted === null) return;
    try {
      await head(wanted);
      if (address !== wanted) return;
      put(message, "");
      inner.src = wanted;
      inner.hidden = false;
    } catch (error) {
      if (address !== wanted) return;
      if (inner.hidden) put(message, error.message); // otherwise the last picture stays
      if ([0, 409, 503].includes(error.status)) timer = setTimeout(open, RETRY); // it is not there yet
    }
  }

  // the page may have gone between the two requests; the frame then has the server's line, or the browser's own error
  inner.addEventListener("load", () => {
    if (inner.hidden) return;
    if (inner.contentDocument?.contentType === "text/html") {
      uncover();
      return;
    }
    inner.hidden = true;
    put(message, "Loading the scene ...");
    timer = setTimeout(open, RETRY);
  });

  // The page inside says what it waits for until it shows something.
  function uncover() {
    clearTimeout(looks);
    const waits = inner.contentDocument?.querySelector("#message.waiting");
    if (waits) looks = setTimeout(uncover, LOOK);
    else cover.classList.add("gone");
  }

  function within(name) {
    try {
      return inner.contentWindow?.[name] ?? null;
    } catch {
      return null;
    }
  }

  return {
    element,
    photo,
    full,
    // hides the panel of the page inside while a photo is shown, on which it would lie
    bare(on) {
      inner.contentDocument?.documentElement.classList.toggle("bare", on);
    },
    // Shows the picture of an entry until the page inside shows something.
    cover(entry) {
      if (entry && !cover.classList.contains("gone")) picture(element, entry);
    },
    show(next, why = "Loading the scene ...") {
      if (inner.hidden) put(message, why);
      if (next === address) return;
      address = next;
      open();
    },
    // Loads the page again, which has become another one.
    again: open,
    close() {
      address = null;
      clearTimeout(timer);
      clearTimeout(looks);
    },
    // the viewer inside, once it has started
    get viewer() {
      return within("viewer");
    },
    // the editor inside, once it has started
    get editor() {
      return within("editor");
    },
  };
}

const stemOf = (name) => name.replace(/\.[^./]+$/, "");

// The photo of a camera: the one whose path ends like the camera's name.
function photoOf(photos, name) {
  const stem = stemOf(name);
  return photos.find((photo) => stemOf(photo.name) === stem || stemOf(photo.name).endsWith(`/${stem}`))?.name ?? null;
}

// Resolves once the frame shows a view whole; to false if another one was chosen meanwhile.
const drawn = (viewer, view) =>
  new Promise((resolve) => {
    const look = () => {
      if (viewer.exact !== view) resolve(false);
      else if (viewer.isWhole) resolve(true);
      else setTimeout(look, GLANCE);
    };
    look();
  });

// Under a frame: choose one of the capture's views, and slide between its photo and the render.
export function beside(scene, captureOf) {
  const select = h("select", { id: "beside-view" }, h("option", { value: "" }, "free view"));
  const range = h("input", { id: "beside", type: "range", min: 0, max: 100, value: 50, disabled: true });
  const note = h("span", { class: "quiet" });
  const element = h(
    "div",
    { class: "beside row" },
    h("label", { for: "beside-view" }, "View"),
    select,
    h("label", { for: "beside" }, "Photo ↔ render"),
    range,
    scene.full,
    note,
  );
  let [known, photos, chosen] = [null, null, null];

  function cut() {
    scene.photo.style.setProperty("--cut", `${100 - Number(range.value)}%`);
    range.setAttribute("aria-valuetext", `photo ${range.value} %, render ${100 - Number(range.value)} %`);
  }

  function free() {
    chosen = null;
    select.value = "";
    scene.bare(false);
    scene.photo.hidden = range.disabled = true;
    note.textContent = "";
  }

  async function choose() {
    const { viewer } = scene;
    const camera = viewer?.facts.cameras[Number(select.value)];
    if (!select.value || !camera) {
      viewer?.reset();
      free();
      return;
    }
    const share = Math.min(1, MOST_SIDE / Math.max(camera.W, camera.H));
    const scaled = (value) => (value + 0.5) * share - 0.5;
    const size = { W: Math.round(camera.W * share), H: Math.round(camera.H * share) };
    const lens = { fx: camera.fx * share, fy: camera.fy * share, cx: scaled(camera.cx), cy: scaled(camera.cy) };
    scene.bare(true);
    viewer.goTo(Number(select.value));
    const view = (viewer.exact = chosen = { ...camera, ...lens, ...size });
    viewer.isWhole = false; // the screen still shows another view
    viewer.askFrame();
    scene.photo.hidden = range.disabled = true;
    note.textContent = "Drawing this view ...";
    const entry = captureOf();
    photos ??= entry ? (await get(at(entry.entry, "photos")).catch(() => ({ photos: [] }))).photos : [];
    if (chosen !== view) return; // another view was chosen meanwhile, or the user moved
    const name = photoOf(photos, camera.name);
    if (!name) {
      note.textContent = "The photo of this view is not in the library.";
      return;
    }
    scene.photo.src = `${at(entry.entry, "thumbs", name)}?side=1024`;
    const isThere = await scene.photo.decode().then(
      () => true,
      () => false,
    );
    if (!(await drawn(viewer, view))) return;
    note.textContent = isThere ? (camera.held_out ? "held out of the training" : "") : "The photo cannot be read.";
    range.disabled = scene.photo.hidden = !isThere;
    cut();
  }

  select.addEventListener("change", choose);
  range.addEventListener("input", cut);
  const timer = setInterval(() => {
    const { viewer } = scene;
    if (viewer && viewer !== known) {
      known = viewer;
      const options = viewer.facts.cameras.map(({ name, held_out: held }, index) => {
        return want("option", { value: index }, held ? `${name} (held out)` : name);
      });
      patch(select, want("option", { value: "" }, "free view"), options);
      free();
    }
    if (chosen && viewer?.exact !== chosen) free(); // the user moved
  }, LOOK);
  return { element, close: () => clearInterval(timer) };
}

// Where the photos of a capture were taken: its cameras in 3D, in a frame.

import { at } from "./api.js";
import { h, heading } from "./dom.js";
import { frame } from "./frame.js";

// left(photo, out) is called after a photo was left out or taken back inside.
// region(drawn) is called after the box was saved or removed inside.
export function places(entry, left, region) {
  const scene = frame(`cameras of ${entry.name}`);
  scene.cover(entry);
  const hint =
    "Click a camera to see its photo and to leave it out. Draw a box to say what a training learns. After an examination, colours show what was found about each photo.";
  const element = h(
    "section",
    { "aria-label": "cameras" },
    heading(2, "Where the photos were taken"),
    h("p", { class: "quiet" }, hint),
    scene.element,
    h("div", { class: "row" }, scene.full),
  );
  let [known, marks, draws] = [null, new Map(), false];
  const changes = new Map(); // photos left out or taken back while the page inside was loading
  // a page that nobody scrolls to costs nothing
  const sight = new IntersectionObserver((seen) => {
    if (!seen.some(({ isIntersecting }) => isIntersecting)) return;
    sight.disconnect();
    scene.show(at(entry.entry, "page"), "Loading the cameras ...");
  });
  sight.observe(element);
  // events of the page inside, which it sends to its frame
  const inner = scene.element.querySelector("iframe");
  inner.addEventListener("started", () => {
    known = scene.viewer;
    known.left(changes);
    changes.clear();
    known.mark(marks);
    if (draws) known.region.draw();
    draws = false;
  });
  inner.addEventListener("region", ({ detail: { drawn } }) => region(drawn));
  inner.addEventListener("left", ({ detail: { photo, out } }) => left(photo, out));
  return {
    element,
    // Colours the cameras by findings: a Map from photos to the names of what was found.
    mark(found) {
      marks = found;
      known?.mark(marks);
    },
    // Photos were left out, or taken back, elsewhere: a Map from photos to whether they are left out.
    left(photos) {
      if (known) known.left(photos);
      else for (const [photo, out] of photos) changes.set(photo, out);
    },
    // Other poses were chosen: shows the page of these.
    read() {
      known = null;
      scene.again();
    },
    // The capture has changed: another tab may have saved or removed the box. A page that loads asks by itself.
    changed() {
      known?.region.load().catch((error) => known.region.say(error.message));
    },
    // Scrolls here and begins to draw the box, as soon as the page inside is there.
    draw() {
      element.scrollIntoView({ block: "start" });
      draws = !known;
      known?.region.draw();
    },
    close() {
      sight.disconnect();
      scene.close();
    },
  };
}

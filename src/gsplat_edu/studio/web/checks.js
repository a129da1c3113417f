// What is known of photos before they are placed: whether they are enough, sharp, equally bright and near enough.

import { at, get } from "./api.js";
import { count, errorLine, h, patch, put, versioned, want, whole } from "./dom.js";

const LATER = "How well photos overlap, and whether they are equally bright, shows once they are placed.";
const TONES = { fatal: "poor", warning: "fair", note: "" };
const COMPARED = ["overlap", "brightness"]; // findings that need photos in the order they were taken

// marked(marks) gets the names of findings by photo; takes(seconds) how long placing the photos takes, or null.
export function checks(entry, marked, takes) {
  const [said, list, line] = [h("p", { role: "status" }), h("ul", { class: "findings" }), errorLine()];
  let closed = false;

  async function measured() {
    for (;;) {
      const found = await get(at(entry, "checks"));
      if (found.findings || closed) return found;
      put(said, `Looking at the photos: ${whole((100 * found.done) / found.total)} % ...`);
    }
  }

  function show({ photos, usual: [least, most], findings, seconds, ordered }) {
    if (closed || !findings || !photos) return;
    takes(seconds);
    const has = (name) => findings.some((finding) => finding.name === name);
    const sharp = has("blurred") ? "" : "None is blurred. ";
    const fine = COMPARED.some(has)
      ? ""
      : "Each shares enough with the next one, and none is clearly brighter or darker.";
    put(said, `${count(photos, "photo")}; ${least} to ${most} are usual. ${sharp}${ordered ? fine : LATER}`);
    const item = ({ name, severity, sentence, advice }) =>
      want(
        "li",
        { class: `banner ${TONES[severity]}`, "data-key": name },
        want("p", {}, `${sentence}.`),
        want("p", {}, `${advice[0].toUpperCase()}${advice.slice(1)}.`),
      );
    patch(list, findings.map(item));
    const marks = new Map();
    for (const { name, images } of findings)
      for (const image of images) marks.set(image, [...(marks.get(image) ?? []), name]);
    marked(marks);
  }

  const found = versioned(line, measured, show);
  return {
    element: h("div", {}, said, list, line),
    read: (now) => found.read(`${now.files} ${now.modified}`),
    close: () => (closed = true),
  };
}

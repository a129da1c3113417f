// What is known of photos before they are placed: whether they are enough, and which are blurred.

import { at, get } from "./api.js";
import { count, errorLine, h, patch, put, versioned, want } from "./dom.js";

const LATER = "How well neighbouring photos overlap, and whether they are equally bright, shows once they are placed.";

// marked(marks) gets the names of findings by photo; takes(seconds) how long placing the photos takes, or null.
export function checks(entry, marked, takes) {
  const [said, list, line] = [h("p", { role: "status" }), h("ul", { class: "findings" }), errorLine()];
  let closed = false;

  async function measured() {
    for (;;) {
      const found = await get(at(entry, "checks"));
      if (found.findings || closed) return found;
      put(said, `Looking for blurred photos: ${found.done} of ${found.total} ...`);
    }
  }

  function show({ total, usual: [least, most], findings, seconds }) {
    if (closed || !findings || !total) return;
    takes(seconds);
    const fine = findings.some(({ name }) => name === "blurred") ? "" : "None is blurred. ";
    put(said, `${count(total, "photo")}; ${least} to ${most} are usual. ${fine}${LATER}`);
    const item = ({ name, severity, sentence, advice }) =>
      want(
        "li",
        { class: `banner ${severity === "fatal" ? "poor" : "fair"}`, "data-key": name },
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

// Previews of photos, and what the doctor says about them.

import { at, get } from "./api.js";
import { bytes, count, h, heading, keyed } from "./dom.js";

const FIRST = 60; // previews at once; more come by a button

const thumbOf = (entry, name, side = 256) => `${at(entry, "thumbs", name)}?side=${side}`;

// A file whose size can be read, but not its pixels.
function damaged({ target }) {
  target.replaceWith(h("span", { class: "thumb error" }, "cannot be read"));
}

// The previews of an entry's photos. findings: Map from a photo's name to the names of what was found.
export function gallery(entry) {
  const facts = h("p", { class: "quiet" });
  const list = h("ul", { class: "thumbs", "aria-label": "photos" });
  const more = h("button", { type: "button", hidden: true, onclick: () => show((shown = Infinity)) });
  let [photos, marks, shown, version, reading] = [[], new Map(), FIRST, "", null];

  function item({ name, W, H, problem, bytes: size }) {
    const detail = problem ?? `${W} × ${H} px, ${bytes(size)}`;
    return h(
      "li",
      { title: `${name}: ${detail}` },
      problem
        ? h("span", { class: "thumb" }, "cannot be read")
        : h("img", { src: thumbOf(entry, name), alt: name, loading: "lazy", width: 160, height: 120, onerror: damaged }),
      h("span", { class: "name" }, name),
      h("span", { class: problem ? "error" : "quiet" }, detail),
      h("span", { class: "mark" }),
    );
  }

  function show() {
    const some = photos.slice(0, shown);
    keyed(list, some, ({ name }) => name, item, (element, { name }) => {
      element.querySelector(".mark").textContent = (marks.get(name) ?? []).join(", ");
    });
    more.hidden = photos.length <= shown;
    more.textContent = `Show all ${photos.length} photos`;
  }

  return {
    element: h("section", { "aria-label": "photos" }, heading(2, "Photos"), facts, list, more),
    mark(found) {
      marks = found;
      show();
    },
    // Reads the photos if they have changed; resolves once they are shown.
    read(now) {
      const next = `${now.files} ${now.modified}`;
      if (next !== version) reading = this.readAgain(now);
      version = next;
      return reading;
    },
    async readAgain(now) {
      photos = (await get(at(entry, "photos"))).photos;
      const sizes = new Map();
      for (const { W, H, problem } of photos) if (!problem) sizes.set(`${W} × ${H}`, (sizes.get(`${W} × ${H}`) ?? 0) + 1);
      const all = [...sizes].sort((a, b) => b[1] - a[1]);
      const parts = all.slice(0, 3).map(([size, number]) => (all.length > 1 ? `${number} of ${size} px` : `${size} px`));
      if (all.length > 3) parts.push(`${all.length - 3} other sizes`);
      const bad = photos.filter(({ problem }) => problem).length;
      if (bad) parts.push(`${bad} cannot be read`);
      const none = now.videos ? "The next step takes sharp frames of the video as photos." : "";
      facts.textContent = photos.length ? [count(photos.length, "photo"), ...parts].join(" · ") : none;
      show();
    },
  };
}

const SEVERITIES = { note: "note", warning: "warning", fatal: "serious" };

// What the doctor found, with the photos that each finding means. Returns the marks of a gallery.
export function showFindings(place, { findings, facts, fine, advice, state, stale }) {
  const marks = new Map();
  const items = findings.map(({ name, severity, sentence, advice: what, images, values, photos }) => {
    const pictures = images.map((image, index) => {
      const [kind, entry, ...rest] = (photos?.[index] ?? "").split("/");
      const photo = rest.join("/");
      if (photo) marks.set(photo, [...(marks.get(photo) ?? []), name]);
      const caption = h("figcaption", {}, values[index] ? `${image}: ${values[index]}` : image);
      const src = photo && thumbOf(`${kind}/${entry}`, photo, 128);
      return h("figure", {}, photo ? h("img", { src, alt: "", loading: "lazy", width: 96, height: 72 }) : null, caption);
    });
    return h(
      "li",
      { class: `finding ${severity}` },
      h("p", {}, h("span", { class: `badge ${severity}` }, SEVERITIES[severity] ?? severity), " ", h("strong", {}, name)),
      h("p", {}, sentence),
      what && h("p", { class: "quiet" }, what),
      pictures.length ? h("div", { class: "figures" }, pictures) : null,
    );
  });
  const said = state === "done" && !findings.length ? [h("p", { class: "good" }, "The doctor found nothing wrong.")] : [];
  const old = stale ? [h("p", { class: "error" }, "This has changed since the doctor looked; examine it again.")] : [];
  const table = facts.length
    ? [h("details", {}, h("summary", {}, "Facts"), h("table", {}, h("tbody", {}, facts.map(([key, value]) => h("tr", {}, h("th", { scope: "row" }, key), h("td", {}, value))))), fine.length ? h("p", { class: "quiet" }, `Nothing wrong with: ${fine.join(", ")}.`) : null)]
    : [];
  const lead = advice.length > 1 ? [h("p", {}, "Most useful first:"), h("ol", {}, advice.map((one) => h("li", {}, one)))] : [];
  place.replaceChildren(...old, ...said, h("ul", { class: "findings" }, items), ...lead, ...table);
  return marks;
}

// Previews of photos, and what the doctor says about them.

import { at, get, post } from "./api.js";
import { announce, attempt, bytes, count, errorLine, h, heading, patch, toned, want } from "./dom.js";
import { drawMask } from "./mask.js";

const FEW = 8; // pictures of photos that were not placed
const FIRST = 60; // previews at once; more come by a button

const thumbOf = (entry, name, side = 256) => `${at(entry, "thumbs", name)}?side=${side}`;

// A button that leaves a photo of a capture out of trainings, or takes it back. out: whether it is left out. label: what
// the photo is called here. changed(out) comes after the change.
function leaving(entry, name, { out, label = name, line, changed }) {
  const text = out ? "Use again" : "Leave out";
  const onclick = ({ currentTarget }) =>
    attempt(currentTarget, line, async () => {
      await post(at(entry, "left-out"), { photos: [name], back: Boolean(out) });
      announce(out ? `${name} is used again` : `${name} is left out`);
      changed(!out);
    });
  return want("button", { type: "button", class: "leave", "aria-label": `${text} ${label}`, onclick }, text);
}

// A button that draws on the mask of a photo. is: whether one is drawn. changed(is) comes after each mask that was saved.
function masking(store, entry, name, { is, label = name, line, changed }) {
  const text = is ? "Change the mask" : "Mask this";
  const draw = () => drawMask(store, entry, name, name.split("/").at(-1), changed);
  const onclick = ({ currentTarget }) => attempt(currentTarget, line, draw);
  return want("button", { type: "button", class: "leave", "aria-label": `${text}: ${label}`, onclick }, text);
}

// The previews of an entry's photos. findings: Map from a photo's name to the names of what was found. changed(photo,
// out) is called after a photo was left out or taken back here, masked() after its mask was changed. store: for captures.
export function gallery(entry, changed = () => {}, masked = () => {}, store = null) {
  const facts = h("p", { class: "quiet" });
  const list = h("ul", { class: "thumbs", "aria-label": "photos" });
  const more = h("button", { type: "button", hidden: true, onclick: () => show((shown = Infinity)) });
  const line = errorLine();
  const isCapture = entry.startsWith("captures/");
  let [photos, videos, marks, shown, version, reading, questions] = [[], 0, new Map(), FIRST, "", null, 0];

  function item(photo) {
    const { name, W, H, problem, bytes: size, left_out: out, masked: drawn } = photo;
    const detail = problem ?? `${W} × ${H} px, ${bytes(size)}`;
    const notes = [...(out ? ["left out"] : []), ...(drawn ? ["masked"] : []), ...(marks.get(name) ?? [])];
    // a file whose size can be read, but not its pixels
    const onerror = () => {
      photo.damaged = true;
      show();
    };
    const noted = (is) => {
      photo.masked = is;
      show();
      masked();
    };
    const leave = (gone) => {
      left(name, gone);
      changed(name, gone);
    };
    return want(
      "li",
      { "data-key": name, title: `${name}: ${detail}`, class: isCapture && out ? "left-out" : null },
      problem || photo.damaged
        ? want("span", { class: problem ? "thumb" : "thumb error" }, "cannot be read")
        : want("img", { src: thumbOf(entry, name), alt: name, loading: "lazy", width: 160, height: 120, onerror }),
      want("span", { class: "name" }, name),
      want("span", { class: problem ? "error" : "quiet" }, detail),
      want("span", { class: "mark" }, notes.join(", ")),
      isCapture && leaving(entry, name, { out, line, changed: leave }),
      isCapture && !problem && masking(store, entry, name, { is: drawn, line, changed: noted }),
    );
  }

  function left(name, out) {
    const photo = photos.find((one) => one.name === name);
    if (photo) photo.left_out = out;
    tell();
    show();
  }

  function show() {
    patch(list, photos.slice(0, shown).map(item));
    more.hidden = photos.length <= shown;
    more.textContent = `Show all ${photos.length} photos`;
  }

  function tell() {
    const sizes = new Map();
    for (const { W, H, problem } of photos) if (!problem) sizes.set(`${W} × ${H}`, (sizes.get(`${W} × ${H}`) ?? 0) + 1);
    const all = [...sizes].sort((a, b) => b[1] - a[1]);
    const parts = all.slice(0, 3).map(([size, number]) => (all.length > 1 ? `${number} of ${size} px` : `${size} px`));
    if (all.length > 3) parts.push(`${all.length - 3} other sizes`);
    const [bad, out] = [
      photos.filter(({ problem }) => problem).length,
      photos.filter(({ left_out: gone }) => gone).length,
    ];
    if (bad) parts.push(`${bad} cannot be read`);
    if (out) parts.push(`${out} left out`);
    const none = videos ? "The next step takes sharp frames of the video as photos." : "";
    facts.textContent = photos.length ? [count(photos.length, "photo"), ...parts].join(" · ") : none;
  }

  return {
    element: h("section", { "aria-label": "photos" }, heading(2, "Photos"), facts, line, list, more),
    mark(found) {
      marks = found;
      show();
    },
    left, // (name, out): a photo was left out, or taken back, elsewhere on the page
    // A Map from the photos to whether they are left out.
    get out() {
      return new Map(photos.map(({ name, left_out: out }) => [name, Boolean(out)]));
    },
    // Reads the photos if they have changed; resolves once they are shown.
    read(now) {
      const next = `${now.files} ${now.modified}`;
      if (next !== version) reading = this.readAgain(now);
      version = next;
      return reading;
    },
    async readAgain(now) {
      const asked = ++questions;
      const found = await get(at(entry, "photos"));
      if (asked !== questions) return reading; // its answer is older than that to a later question
      photos = found.photos;
      videos = now.videos;
      tell();
      show();
      return undefined;
    },
  };
}

// Photos of a capture that could not be placed, with what to do: nothing of what only they show will be in the scene.
// photos: the entry that they lie in, or null.
export function unplaced({ search }, photos) {
  const names = search?.unplaced ?? [];
  if (!names.length) return null;
  const whole = search.photos === null ? "" : ` of ${search.photos}`;
  const [were, each] = names.length === 1 ? ["was", "it"] : ["were", "each of them"];
  const figure = (name, index) => {
    const image = photos && want("img", { src: thumbOf(photos, name, 128), alt: "", width: 96, height: 72 });
    const [before, after] = search.beside[index];
    const where = before && after ? `between ${before} and ${after}` : `beside ${before ?? after}`;
    const place = (before ?? after) && want("span", { class: "quiet" }, `Take two more ${where}.`);
    return want("figure", { "data-key": name }, image, want("figcaption", {}, name, " ", place));
  };
  const advice = `Take two more photos beside ${each}, which share most of what they show, add them to the photos, and place the photos again. What only ${names.length === 1 ? "this photo shows" : "these photos show"} will be missing.`;
  return want(
    "div",
    { class: "notice unplaced", role: "group", "aria-label": "photos that were not placed" },
    want("p", {}, want("strong", {}, `${names.length}${whole} photos ${were} not placed. `), advice),
    want("div", { class: "figures" }, names.slice(0, FEW).map(figure)),
    names.length > FEW && want("p", {}, `And ${names.length - FEW} more.`),
  );
}

const SEVERITIES = { note: "note", warning: "warning", fatal: "serious" };

// What the doctor found, with the photos that each finding means. Returns the marks of a gallery.
// offer(proposal) makes the button or link of something that the page can do about a finding.
// store: what the studio knows. left(path, photo, out) is called after a photo of a finding was left out or taken back,
// drawn(path, is) after its mask was changed; both show the findings again. path: kind, entry and photo. line: for errors.
export function showFindings(
  place,
  offer,
  { store, line, left, drawn },
  { findings, facts, fine, advice, state, stale },
) {
  const marks = new Map();
  const items = findings.map(
    ({ name, severity, sentence, advice: what, images, values, photos, left_out: gone, masked, proposals }) => {
      const pictures = images.map((image, index) => {
        const path = photos?.[index] ?? "";
        const [kind, entry, ...rest] = path.split("/");
        const photo = rest.join("/");
        if (kind === "captures") marks.set(photo, [...(marks.get(photo) ?? []), name]);
        const caption = want("figcaption", {}, values[index] ? `${image}: ${values[index]}` : image);
        if (!photo) return want("figure", {}, caption);
        const src = thumbOf(`${kind}/${entry}`, photo, 128);
        const [out, is] = [gone[index], masked[index]];
        return want(
          "figure",
          { class: out ? "left-out" : null },
          want("img", { src, alt: "", loading: "lazy", width: 96, height: 72 }),
          caption,
          kind === "captures" && [
            leaving(`${kind}/${entry}`, photo, { out, label: image, line, changed: (now) => left(path, photo, now) }),
            masking(store, `${kind}/${entry}`, photo, { is, label: image, line, changed: (now) => drawn(path, now) }),
          ],
        );
      });
      return want(
        "li",
        { class: "finding card", "data-key": name },
        want("p", {}, toned(severity, SEVERITIES[severity] ?? severity), " ", want("strong", {}, name)),
        want("p", {}, sentence),
        what && want("p", { class: "quiet" }, what),
        pictures.length ? want("div", { class: "figures" }, pictures) : null,
        proposals.length ? want("p", { class: "row" }, proposals.map(offer)) : null,
      );
    },
  );
  const row = ([key, value]) => want("tr", {}, want("th", { scope: "row" }, key), want("td", {}, value));
  patch(
    place,
    stale && want("p", { class: "error" }, "This has changed since the doctor looked; examine it again."),
    state === "done" && !findings.length && want("p", { class: "banner good" }, "The doctor found nothing wrong."),
    line,
    advice.length > 1 && [
      want("p", {}, "Most useful first:"),
      want(
        "ol",
        {},
        advice.map((one) => want("li", {}, one)),
      ),
    ],
    want("ul", { class: "findings" }, items),
    facts.length > 0 &&
      want(
        "details",
        {},
        want("summary", {}, "Facts"),
        want("table", {}, want("tbody", {}, facts.map(row))),
        fine.length > 0 && want("p", { class: "quiet" }, `Nothing wrong with: ${fine.join(", ")}.`),
      ),
  );
  return marks;
}

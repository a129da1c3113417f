// Previews of photos, and what the doctor says about them.

import { at, get, post } from "./api.js";
import { announce, attempt, bytes, button, count, errorLine, h, heading, keyed, put, renew } from "./dom.js";
import { drawMask } from "./mask.js";

const FIRST = 60; // previews at once; more come by a button

const thumbOf = (entry, name, side = 256) => `${at(entry, "thumbs", name)}?side=${side}`;

// A file whose size can be read, but not its pixels.
function damaged({ target }) {
  target.replaceWith(h("span", { class: "thumb error" }, "cannot be read"));
}

const LEAVE = "Leave out";
const TAKE = "Use again";

// A button that leaves a photo of a capture out of trainings, or takes it back; changed(out) comes after it.
function leaving(entry, name, line, changed) {
  const pressed = button("", () =>
    attempt(pressed, line, async () => {
      const back = pressed.textContent === TAKE;
      await post(at(entry, "left-out"), { photos: [name], back });
      announce(back ? `${name} is used again` : `${name} is left out`);
      changed(!back);
    }),
  );
  pressed.className = "leave";
  return pressed;
}

// A button that draws on the mask of a photo; changed(isMasked) comes after each mask that was saved.
function masking(store, entry, name, line, changed) {
  const pressed = button("Mask this", () =>
    attempt(pressed, line, () =>
      drawMask(store, entry, name, name.split("/").at(-1), (is) => {
        tellMasked(pressed, name, is);
        changed(is);
      }),
    ),
  );
  pressed.className = "leave";
  return pressed;
}

function tellMasked(pressed, name, is) {
  put(pressed, is ? "Change the mask" : "Mask this");
  pressed.setAttribute("aria-label", `${pressed.textContent}: ${name}`);
}

// What such a button says, and how its photo looks.
function tellLeft(item, pressed, name, out) {
  put(pressed, out ? TAKE : LEAVE);
  pressed.setAttribute("aria-label", `${pressed.textContent} ${name}`);
  item.classList.toggle("left-out", out);
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

  function item({ name, W, H, problem, bytes: size }) {
    const detail = problem ?? `${W} × ${H} px, ${bytes(size)}`;
    return h(
      "li",
      { title: `${name}: ${detail}` },
      problem
        ? h("span", { class: "thumb" }, "cannot be read")
        : h("img", {
            src: thumbOf(entry, name),
            alt: name,
            loading: "lazy",
            width: 160,
            height: 120,
            onerror: damaged,
          }),
      h("span", { class: "name" }, name),
      h("span", { class: problem ? "error" : "quiet" }, detail),
      h("span", { class: "mark" }),
      isCapture
        ? leaving(entry, name, line, (out) => {
            left(name, out);
            changed(name, out);
          })
        : null,
      isCapture && !problem
        ? Object.assign(masking(store, entry, name, line, masked), { className: "leave masking" })
        : null,
    );
  }

  function left(name, out) {
    const photo = photos.find((one) => one.name === name);
    if (photo) photo.left_out = out;
    tell();
    show();
  }

  function show() {
    const some = photos.slice(0, shown);
    keyed(
      list,
      some,
      ({ name }) => name,
      item,
      (element, { name, left_out: out, masked: drawn }) => {
        element.querySelector(".mark").textContent = [
          ...(out ? ["left out"] : []),
          ...(drawn ? ["masked"] : []),
          ...(marks.get(name) ?? []),
        ].join(", ");
        if (isCapture) tellLeft(element, element.querySelector(".leave"), name, out);
        const mask = element.querySelector(".masking");
        if (mask) tellMasked(mask, name, drawn);
      },
    );
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

const SEVERITIES = { note: "note", warning: "warning", fatal: "serious" };

// What the doctor found, with the photos that each finding means. Returns the marks of a gallery.
// offer(proposal) makes the button or link of something that the page can do about a finding.
// store: what the studio knows. left(photo, out) is called after a photo of a finding was left out or taken back, drawn() after its mask was changed.
export function showFindings(place, offer, { store, left, drawn }, { findings, facts, fine, advice, state, stale }) {
  const marks = new Map();
  const line = errorLine();
  const items = findings.map(
    ({ name, severity, sentence, advice: what, images, values, photos, left_out: gone, masked, proposals }) => {
      const pictures = images.map((image, index) => {
        const [kind, entry, ...rest] = (photos?.[index] ?? "").split("/");
        const photo = rest.join("/");
        if (photo) marks.set(photo, [...(marks.get(photo) ?? []), name]);
        const caption = h("figcaption", {}, values[index] ? `${image}: ${values[index]}` : image);
        const src = photo && thumbOf(`${kind}/${entry}`, photo, 128);
        const figure = h(
          "figure",
          {},
          photo ? h("img", { src, alt: "", loading: "lazy", width: 96, height: 72 }) : null,
          caption,
        );
        if (photo) {
          const pressed = leaving(`${kind}/${entry}`, photo, line, (out) => {
            tellLeft(figure, pressed, image, out);
            left(photo, out);
          });
          tellLeft(figure, pressed, image, gone[index]);
          const mask = masking(store, `${kind}/${entry}`, photo, line, drawn);
          tellMasked(mask, image, masked[index]);
          figure.append(pressed, mask);
        }
        return figure;
      });
      return h(
        "li",
        { class: `finding ${severity}` },
        h(
          "p",
          {},
          h("span", { class: `badge ${severity}` }, SEVERITIES[severity] ?? severity),
          " ",
          h("strong", {}, name),
        ),
        h("p", {}, sentence),
        what && h("p", { class: "quiet" }, what),
        pictures.length ? h("div", { class: "figures" }, pictures) : null,
        proposals.length ? h("p", { class: "row" }, proposals.map(offer)) : null,
      );
    },
  );
  const said =
    state === "done" && !findings.length ? [h("p", { class: "good" }, "The doctor found nothing wrong.")] : [];
  const old = stale ? [h("p", { class: "error" }, "This has changed since the doctor looked; examine it again.")] : [];
  const table = facts.length
    ? [
        h(
          "details",
          {},
          h("summary", {}, "Facts"),
          h(
            "table",
            {},
            h(
              "tbody",
              {},
              facts.map(([key, value]) => h("tr", {}, h("th", { scope: "row" }, key), h("td", {}, value))),
            ),
          ),
          fine.length ? h("p", { class: "quiet" }, `Nothing wrong with: ${fine.join(", ")}.`) : null,
        ),
      ]
    : [];
  const lead =
    advice.length > 1
      ? [
          h("p", {}, "Most useful first:"),
          h(
            "ol",
            {},
            advice.map((one) => h("li", {}, one)),
          ),
        ]
      : [];
  renew(place, ...old, ...said, line, h("ul", { class: "findings" }, items), ...lead, ...table);
  return marks;
}

// Judges a run by the photos that it was not trained on, and compares two runs.

import { at, get } from "./api.js";
import { decibels, errorLine, h, heading, link, patch, put, versioned, want } from "./dom.js";
import { doctor } from "./doctor.js";

const PICTURES = ["photo", "render", "difference"];

const pictureOf = (entry, index, what) => at(entry, "views", String(index), `${what}.png`);
const previewOf = (entry, index, what) => at(entry, "views", String(index), `${what}.jpg`);

// Two pictures on top of each other; a slider shows more of one or the other.
export function slider(left, right, names, label, { W, H }) {
  const range = h("input", {
    type: "range",
    min: 0,
    max: 100,
    value: 50,
    "aria-label": `${label}: ${names.join(" or ")}`,
  });
  const size = { width: W, height: H }; // they keep the place until they are there
  const top = h("img", { class: "top", src: left, alt: `${names[0]} of ${label}`, ...size });
  const stack = h("div", { class: "stack" }, h("img", { src: right, alt: `${names[1]} of ${label}`, ...size }), top);
  const cut = () => {
    stack.style.setProperty("--cut", `${100 - Number(range.value)}%`);
    range.setAttribute("aria-valuetext", `${names[0]} ${range.value} %, ${names[1]} ${100 - Number(range.value)} %`);
  };
  range.addEventListener("input", cut);
  cut();
  return h(
    "figure",
    { class: "slider" },
    stack,
    h("figcaption", {}, h("span", {}, names[0]), range, h("span", {}, names[1])),
  );
}

// How good a run is and what to do, in words, with the decibels folded; empty without a verdict.
export function verdictOf({ verdict: found }) {
  if (!found) return [];
  const { grade, sentence, details } = found;
  const said = want("p", { class: `verdict banner ${grade.toLowerCase()}` }, sentence);
  return details ? [said, want("details", {}, want("summary", {}, "Details"), want("p", {}, details))] : [said];
}

export function judge({ place, store, entry, where }) {
  const line = errorLine();
  const facts = h("div", { class: "facts" });
  const list = h("ul", { class: "views", "aria-label": "held-out views" });
  const large = h("div", { class: "large" });
  const order = h(
    "select",
    { id: "order", onchange: () => show() },
    [
      ["worst", "worst first"],
      ["best", "best first"],
      ["name", "by name"],
    ].map(([value, text]) => h("option", { value }, text)),
  );
  const checked = doctor(store, entry.entry, "Says what may be wrong with this run, and what to change.");
  const others = h("select", {
    id: "other",
    onchange: () =>
      others.value &&
      (location.hash = `#/runs/${encodeURIComponent(entry.name)}/compare/${encodeURIComponent(others.value)}`),
  });
  const choice = h(
    "p",
    { class: "row" },
    h("label", { for: "order" }, "Order"),
    order,
    h("label", { for: "other" }, "Compare with"),
    others,
  );
  place.append(
    h("section", { "aria-label": "held-out views" }, heading(2, "Held-out views"), facts, line, large, choice, list),
    checked.element,
  );
  const report = h(
    "p",
    { hidden: true },
    link("Open the report", at(entry.entry, "report"), { class: "button", target: "_blank" }),
  );
  list.after(report);
  choice.hidden = checked.element.hidden = true; // until what is above them is there
  let [views, version, now, opened] = [[], "", entry, where.query.get("view")];
  const base = `#/runs/${encodeURIComponent(entry.name)}/judge`;

  function show() {
    const ordered = [...views];
    if (order.value === "best") ordered.reverse();
    if (order.value === "name") ordered.sort((a, b) => a.name.localeCompare(b.name));
    patch(
      list,
      ordered.map(({ index, name, psnr, ssim }) => {
        const pictures = PICTURES.map((what) => {
          const src = previewOf(entry.entry, index, what);
          return want(
            "figure",
            {},
            want("img", { src, alt: `${what} of ${name}`, loading: "lazy" }),
            want("figcaption", {}, what),
          );
        });
        const score = `${decibels(psnr)}${typeof ssim === "number" ? `, SSIM ${ssim.toFixed(3)}` : ""}`;
        const top = [want("a", { href: `${base}?view=${index}` }, name), want("span", { class: "quiet" }, score)];
        return want(
          "li",
          { "data-key": `${index} ${version}` }, // a new version has new pictures
          want("p", { class: "row" }, top),
          want("div", { class: "triple" }, pictures),
        );
      }),
    );
    open();
  }

  function open() {
    const view = views.find(({ index }) => String(index) === opened);
    if (large.dataset.view === (view ? opened : "")) return undefined;
    large.dataset.view = view ? opened : "";
    if (!view) return patch(large);
    const pictures = ["photo", "render"].map((what) => pictureOf(entry.entry, view.index, what));
    return patch(
      large,
      heading(3, view.name),
      slider(...pictures, ["photo", "render"], view.name, view),
      link("Close", base, { class: "button" }),
    );
  }

  function reveal() {
    choice.hidden = checked.element.hidden = false;
    report.hidden = !now.finished; // a training writes it at its end
  }

  function showViews({ views: found }) {
    views = found;
    const none = "There are no held-out views yet. They are rendered when the training ends.";
    const hint = found.length ? "Differences are shown 4 times as strong." : none;
    patch(facts, [...verdictOf(now), want("p", {}, hint)]);
    show();
  }

  const held = versioned(line, () => get(at(entry.entry, "views")), showViews, reveal);

  return {
    follows(next) {
      opened = next.query.get("view");
      open();
      if (opened) large.scrollIntoView({ block: "nearest" });
      return true;
    },
    update(found) {
      now = found;
      checked.update(now);
      const runs = store.entries("runs").filter(({ name }) => name !== entry.name);
      patch(
        others,
        want("option", { value: "" }, runs.length ? "another run" : "no other run"),
        runs.map(({ name }) => want("option", { value: name, "data-key": name }, name)),
      );
      version = `${now.finished} ${now.psnr} ${now.iterations}`;
      held.read(version);
    },
  };
}

// Which of two runs is better, in words: the winner is named first, whichever was opened.
function verdict(one, other, views) {
  const scored = views.filter(({ gain }) => typeof gain === "number");
  if (!scored.length) return "Their views have no scores.";
  const mean = (side) => decibels(scored.reduce((sum, view) => sum + view[side].psnr, 0) / scored.length);
  const wins = [scored.filter(({ gain }) => gain < 0).length, scored.filter(({ gain }) => gain > 0).length];
  const [winner, count] = wins[1] > wins[0] ? [other, wins[1]] : [one, wins[0]];
  const begin = wins[0] === wins[1] ? `Both are better in ${count}` : `${winner} is better in ${count}`;
  return `${begin} of ${scored.length} views. Mean PSNR: ${one} ${mean("a")}, ${other} ${mean("b")}. The views are ordered by the gain of ${other}, the smallest first.`;
}

// Two runs, view by view.
export function compare({ place, entry, where }) {
  const other = where.more;
  const line = errorLine();
  const facts = h("p", { class: "facts" });
  const list = h("ul", { class: "views", "aria-label": "views of both runs" });
  const back = `#/runs/${encodeURIComponent(entry.name)}/judge`;
  place.append(
    h(
      "section",
      { "aria-label": "comparison" },
      heading(2, `${entry.name} and ${other}`),
      h("p", {}, link("Close", back, { class: "button" })),
      facts,
      line,
      list,
    ),
  );
  const [a, b] = [entry.entry, `runs/${other}`];
  get(`/api/compare?a=${encodeURIComponent(entry.name)}&b=${encodeURIComponent(other)}`).then(
    ({ views, only_a: onlyA, only_b: onlyB }) => {
      const rest =
        onlyA.length + onlyB.length ? ` ${onlyA.length + onlyB.length} views are held out of one of them only.` : "";
      facts.textContent = views.length
        ? `${verdict(entry.name, other, views)}${rest}`
        : "These runs hold out no common view.";
      list.append(
        ...views.map(({ name, a: one, b: two, gain }) => {
          const pictures = [
            [a, one, "photo", "photo"],
            [a, one, "render", entry.name],
            [b, two, "render", other],
          ].map(([from, view, what, title]) => {
            const score = what === "render" ? ` ${decibels(view.psnr)}` : "";
            return h(
              "figure",
              {},
              h("img", {
                src: previewOf(from, view.index, what),
                alt: `${what} of ${name}, ${title}`,
                loading: "lazy",
              }),
              h("figcaption", {}, `${title}${score}`),
            );
          });
          const change = typeof gain === "number" ? `${gain > 0 ? "+" : ""}${gain.toFixed(2)} dB` : "";
          const sides = ["render", "render"].map((what, i) => pictureOf(i ? b : a, (i ? two : one).index, what));
          const more = h(
            "details",
            {
              ontoggle: () =>
                more.open && more.children.length === 1 && more.append(slider(...sides, [entry.name, other], name)),
            },
            h("summary", {}, "Slide between both"),
          );
          return h(
            "li",
            {},
            h("p", { class: "row" }, h("strong", {}, name), h("span", { class: "quiet" }, change)),
            h("div", { class: "triple" }, pictures),
            more,
          );
        }),
      );
    },
    (error) => put(line, error.message),
  );
  return { follows: (next) => next.more === other };
}

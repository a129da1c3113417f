// The screen of a capture: previews, the doctor's findings, and the start of a training with its forecast.

import { at, get } from "./api.js";
import {
  attempt,
  button,
  duration,
  errorLine,
  forecastText,
  h,
  heading,
  link,
  patch,
  put,
  versioned,
  want,
} from "./dom.js";
import { choices } from "./choices.js";
import { doctor } from "./doctor.js";
import { gallery, unplaced } from "./gallery.js";
import { startJob } from "./jobs.js";
import { addressOf, factsOf } from "./entries.js";
import { entryHead, management, withEntry } from "./screen.js";
import { places } from "./places.js";
import { poses } from "./poses.js";

const QUALITIES = [
  ["draft", "Draft", "a quick look"],
  ["standard", "Standard", "good for most scenes"],
  ["high", "High", "fine detail, several times as long"],
];

export function capture(given) {
  const { store } = given;
  return withEntry(given, (entry, stage) => {
    let part = entry.unfinished ? search(store, stage, entry) : training(store, stage, entry);
    return {
      entry,
      close: () => part.close?.(),
      update(now) {
        if (part.unfinished && now.unfinished === false) {
          part.clear();
          part = training(store, stage, now);
        }
        part.update(now);
      },
    };
  });
}

// A capture that has no poses: its search runs, or was stopped, or failed.
function search(store, stage, entry) {
  const head = entryHead(store, entry);
  const job = [...store.jobs.values()]
    .filter(({ job: { work } }) => work.command === "sfm" && work.outputs[0] === entry.entry)
    .at(-1);
  const said = h(
    "p",
    {},
    "These photos are not placed yet. The screen of the photos shows how far that is, or lets you try again.",
  );
  const photos = job
    ? h("p", { class: "next" }, link("Go to the photos", `#/${at(job.job.subject).slice(5)}`, { class: "button" }))
    : null;
  const parts = [head.element, said, photos, management(store, entry)].filter(Boolean);
  stage.append(...parts);
  return { unfinished: true, update: (now) => head.update(now), clear: () => parts.forEach((part) => part.remove()) };
}

// The screen of a capture with poses.
function training(store, stage, entry) {
  const head = entryHead(store, entry);
  const line = errorLine();
  const pictures = gallery(
    entry.entry,
    (photo, out) => {
      taken.left(new Map([[photo, out]]));
      store.refresh();
    },
    () => store.refresh(),
    store,
  );
  const taken = places(
    entry,
    (photo, out) => {
      pictures.left(photo, out);
      store.refresh();
    },
    (drawn) => start.drawn(drawn),
  );
  const checked = doctor(
    store,
    entry.entry,
    "Looks for blurred or misplaced photos, gaps and other faults before you spend time on a training.",
    (marks) => [pictures, taken].forEach((part) => part.mark(marks)),
    (photo, out) => {
      pictures.left(photo, out);
      taken.left(new Map([[photo, out]]));
    },
  );
  const start = startForm(store, entry, () => taken.draw());
  const whose = poses(entry, () => {
    taken.read();
    store.refresh();
  });
  const later = h("div", { class: "later", hidden: true }, management(store, entry));
  const missing = h("div", {});
  const said = h("ul", { class: "plain quiet", "aria-label": "what was read", hidden: true });
  const runs = h("ul", { class: "plain" });
  const past = h("section", { "aria-label": "runs", hidden: true }, heading(2, "Trained from these photos"), runs);
  stage.append(
    head.element,
    said,
    whose.element,
    missing,
    h("div", { class: "watch" }, taken.element, start.element),
    past,
    checked.element,
    pictures.element,
    line,
    later,
  );
  const notes = versioned(
    line,
    () => get(at(entry.entry, "notes")),
    ({ notes: lines }) => {
      said.hidden = !lines.length;
      patch(
        said,
        lines.map((text) => want("li", {}, text)),
      );
    },
  );
  let version = entry.modified;
  return {
    close: () => taken.close(),
    update(now) {
      head.update(now);
      patch(missing, unplaced(now, now.made_from));
      notes.read(now.modified);
      whose.read(now);
      checked.update(now);
      start.update(now);
      if (now.modified !== version) taken.changed();
      version = now.modified;
      const shown = () => {
        later.hidden = false;
        taken.left(pictures.out); // another tab may have left some out
      };
      pictures.read(now).then(shown, (error) => put(line, error.message));
      const own = store.entries("runs").filter((run) => store.captureOf(run)?.entry === entry.entry);
      past.hidden = !own.length;
      patch(
        runs,
        own.map((run) => {
          const facts = factsOf(run).filter(Boolean).join(" · ");
          const to = want("a", { href: addressOf(run) }, run.name);
          return want("li", { class: "row", "data-key": run.name }, to, want("span", { class: "quiet" }, facts));
        }),
      );
    },
  };
}

// Choose a quality, see what it takes, and start.
function startForm(store, entry, draw) {
  const line = errorLine();
  const forecastLine = errorLine();
  const said = new Map();
  const qualities = QUALITIES.map(([value, title, hint], index) => {
    const facts = h("span", { class: "forecast quiet" }, "\u00a0");
    said.set(value, facts);
    const input = h("input", { type: "radio", name: "quality", value, checked: index === 1 });
    return h(
      "label",
      { class: "choice card" },
      input,
      h("strong", {}, title),
      h("span", { class: "quiet" }, hint),
      facts,
    );
  });
  const more = choices(draw);
  const name = h("input", {
    id: "run-name",
    type: "text",
    autocomplete: "off",
    placeholder: "a free one after the photos",
  });
  const go = h("button", { "data-own": "" }, "Start training");
  const measure = button("Forecast time and memory", () => forecast());
  let times = {}; // by quality
  let asked = false; // for a forecast

  // Tells the next step how long the training takes that is chosen; of a number of iterations, nothing is known.
  function tellTime() {
    const form = element.querySelector("form");
    const quality = new FormData(form).get("quality");
    const isKnown = times[quality] && more.options(quality).quality === quality;
    form.dataset.takes = isKnown ? `takes about ${duration(times[quality].seconds)}` : "";
    store.changed();
  }

  async function forecast() {
    asked = true;
    measure.hidden = true;
    for (const facts of said.values()) facts.textContent = "measuring ...";
    try {
      const size = more.resolution();
      const resolution = size ? `?resolution=${encodeURIComponent(size)}` : "";
      const { qualities: forecasts } = await get(at(entry.entry, "forecast") + resolution);
      for (const [value, facts] of said) facts.textContent = forecastText(forecasts[value]);
      times = forecasts;
      tellTime();
    } catch (error) {
      for (const facts of said.values()) facts.textContent = "\u00a0";
      put(forecastLine, error.message);
    }
    measure.hidden = false;
    measure.textContent = "Forecast again";
  }

  const element = h(
    "section",
    { "aria-label": "training" },
    heading(2, "Training"),
    h(
      "form",
      {
        id: "train",
        "data-next": `train ${entry.entry}`,
        onchange: () => tellTime(),
        onsubmit: (event) => {
          event.preventDefault();
          attempt(go, line, async () => {
            const options = more.options(new FormData(event.target).get("quality"));
            const to = name.value ? { to: name.value } : {}; // without one, the studio chooses a free name
            const { job } = await startJob(store, { command: "train", subject: entry.entry, ...to, options });
            await store.refresh();
            location.hash = `#/${job.subject.split("/").map(encodeURIComponent).join("/")}`;
          });
        },
      },
      h("fieldset", {}, h("legend", {}, "Quality"), h("div", { class: "choices" }, qualities)),
      forecastLine,
      h(
        "details",
        {},
        h("summary", {}, "More"),
        h("label", { class: "wide" }, "Name of the training", name),
        more.element,
      ),
      h("div", { class: "row" }, go, measure),
      line,
    ),
  );
  // the training and the page of the cameras also report a box that cannot be read
  let [version, questions, isDrawn] = [null, 0, false];

  // The capture has a box, or none. What the user has chosen stays if that is as before.
  function drawn(is) {
    questions += 1; // answers to earlier questions are old
    if (is !== isDrawn) more.drawn(is);
    isDrawn = is;
  }

  async function askForBox() {
    const asked = ++questions;
    const { region } = await get(at(entry.entry, "region"));
    if (asked === questions) drawn(Boolean(region));
  }

  return {
    element,
    drawn,
    update(now) {
      if (now.modified !== version) askForBox().catch((error) => put(line, error.message));
      version = now.modified;
      if (asked || !store.entry("captures", entry.name)?.layout) return; // that of a new capture comes later
      // measuring takes seconds of the processor, which a running job needs
      if (![...store.jobs.values()].some(({ active }) => active)) forecast();
    },
  };
}

// The screen of a capture: previews, the doctor's findings, and the start of a training with its forecast.

import { at, get } from "./api.js";
import { attempt, bytes, button, duration, errorLine, h, heading, keyed, link, put, whole } from "./dom.js";
import { doctor } from "./doctor.js";
import { gallery } from "./gallery.js";
import { freeName } from "./intake.js";
import { startJob } from "./jobs.js";
import { addressOf, entryHead, factsOf, management, withEntry } from "./library.js";

const QUALITIES = [
  ["draft", "Draft", "a quick look"],
  ["standard", "Standard", "good for most scenes"],
  ["high", "High", "fine detail, several times as long"],
];

const OUTSIDE = [
  ["", "decide from the masks"],
  ["empty", "empty: the masks cut out an object"],
  ["ignore", "ignore: the masks hide something in front"],
];

const PURPOSES = [
  ["", "to look at"],
  ["surface", "for a mesh: learn surfaces"],
];

const DEPTHS = [
  ["", "none"],
  ["points", "the points that photos share"],
  ["capture", "the capture's own depth maps"],
];

const NUMBER_OR_AUTO = "auto|[0-9]+([.][0-9]+)?";

export function capture(given) {
  const { main, store } = given;
  return withEntry(given, (entry) => {
    const head = entryHead(entry, "Capture");
    const line = errorLine();
    const pictures = gallery(entry.entry);
    const checked = doctor(
      store,
      entry.entry,
      "Looks for blurred photos, wrong poses, gaps and other faults before you spend time on a training.",
      (marks) => pictures.mark(marks),
    );
    const start = startForm(store, entry);
    const later = h("div", { class: "later", hidden: true }, management(store, entry));
    const runs = h("ul", { class: "plain" });
    const past = h("section", { "aria-label": "runs", hidden: true }, heading(2, "Runs of this capture"), runs);
    main.append(head.element, start.element, past, checked.element, pictures.element, line, later);
    return {
      entry,
      update(now) {
        head.update(now);
        checked.update(now);
        start.update(now);
        pictures.read(now).then(() => (later.hidden = false), (error) => put(line, error.message));
        const own = store.entries("runs").filter((run) => run.capture && store.entryAt(run.capture)?.entry === entry.entry);
        past.hidden = !own.length;
        keyed(runs, own, ({ name }) => name, (run) => h("li", { class: "row" }, link(run.name, addressOf(run)), h("span", { class: "quiet" })), (item, run) => {
          item.lastChild.textContent = factsOf(run).filter(Boolean).join(" · ");
        });
      },
    };
  });
}

function chooser(id, choices) {
  return h("select", { id }, choices.map(([value, text]) => h("option", { value }, text)));
}

// Choose a quality, see what it takes, and start.
function startForm(store, entry) {
  const line = errorLine();
  const forecastLine = errorLine();
  const said = new Map();
  const choices = QUALITIES.map(([value, title, hint], index) => {
    const facts = h("span", { class: "forecast quiet" }, "\u00a0");
    said.set(value, facts);
    const input = h("input", { type: "radio", name: "quality", value, checked: index === 1 });
    return h("label", { class: "choice" }, input, h("strong", {}, title), h("span", { class: "quiet" }, hint), facts);
  });
  const fields = {
    iterations: h("input", { id: "iterations", type: "number", min: 1, max: 1000000, inputmode: "numeric" }),
    resolution: h("input", { id: "resolution", type: "text", placeholder: "full size", autocomplete: "off", pattern: NUMBER_OR_AUTO }),
    time_limit: h("input", { id: "time-limit", type: "text", placeholder: "30m", autocomplete: "off" }),
    max_memory: h("input", { id: "max-memory", type: "text", placeholder: "8G", autocomplete: "off" }),
    max_gaussians: h("input", { id: "max-gaussians", type: "number", min: 1, inputmode: "numeric" }),
    outside_masks: chooser("outside-masks", OUTSIDE),
    surface: chooser("surface", PURPOSES),
    depth: chooser("depth", DEPTHS),
  };
  const labels = {
    iterations: "Iterations instead of a quality",
    resolution: "Size of the photos: 2 for half, longest side in px, or auto",
    time_limit: "Time instead of a quality",
    max_memory: "Memory limit",
    max_gaussians: "Splats at most",
    outside_masks: "Outside of the photos' masks",
    surface: "What the scene is for",
    depth: "Depth to learn from",
  };
  const name = h("input", { id: "run-name", type: "text", autocomplete: "off" });
  const go = h("button", { class: "primary" }, "Start training");
  const measure = button("Forecast time and memory", () => forecast());

  async function forecast() {
    measure.hidden = true;
    for (const facts of said.values()) facts.textContent = "measuring ...";
    try {
      const resolution = fields.resolution.value ? `?resolution=${encodeURIComponent(fields.resolution.value)}` : "";
      const { qualities } = await get(at(entry.entry, "forecast") + resolution);
      for (const [value, facts] of said) {
        const { seconds, bytes: memory, gaussians, iterations } = qualities[value];
        facts.textContent = `about ${duration(seconds)}, ${bytes(memory)} of memory; ${whole(iterations)} iterations, up to ${whole(gaussians)} splats`;
      }
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
        onsubmit: (event) => {
          event.preventDefault();
          attempt(go, line, async () => {
            const own = fields.iterations.value || fields.time_limit.value; // takes the place of a quality
            const options = own ? {} : { quality: new FormData(event.target).get("quality") };
            for (const [key, field] of Object.entries(fields)) {
              if (!field.value) continue;
              const number = field.type === "number" || (key === "resolution" && field.value !== "auto");
              options[key] = key === "surface" || (number ? Number(field.value) : field.value);
            }
            const to = name.value || freeName(store, "runs", entry.name);
            const { job } = await startJob(store, { command: "train", subject: entry.entry, to, options });
            await store.refresh();
            location.hash = `#/${job.subject.split("/").map(encodeURIComponent).join("/")}`;
          });
        },
      },
      h("fieldset", {}, h("legend", {}, "Quality"), h("div", { class: "choices" }, choices)),
      forecastLine,
      h(
        "details",
        {},
        h("summary", {}, "Options"),
        h("div", { class: "grid" }, [
          h("label", {}, "Name of the run", name),
          Object.entries(fields).map(([key, field]) => h("label", {}, labels[key], field)),
        ]),
      ),
      h("div", { class: "row" }, go, measure),
      line,
    ),
  );
  let asked = false;
  return {
    element,
    update() {
      name.placeholder = freeName(store, "runs", entry.name);
      if (asked || !store.entry("captures", entry.name)?.layout) return; // that of a new capture comes later
      asked = true;
      // measuring takes seconds of the processor, which a running job needs
      if (![...store.jobs.values()].some(({ active }) => active)) forecast();
    },
  };
}


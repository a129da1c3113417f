// The screen of photos without poses: previews, and the first step, which finds the poses.

import { checks } from "./checks.js";
import { attempt, duration, errorLine, h, heading, patch, put, want } from "./dom.js";
import { gallery, unplaced } from "./gallery.js";
import { intake } from "./intake.js";
import { jobPlace, startJob } from "./jobs.js";
import { addressOf, searchOf } from "./entries.js";
import { entryHead, management, withEntry } from "./screen.js";

const MATCHERS = [
  ["", "chosen by what the photos are"],
  ["exhaustive", "every photo with every other one"],
  ["sequential", "photos in the order they were taken"],
];

export function photos(given) {
  const { store } = given;
  return withEntry(given, (entry, stage) => {
    let seconds = null; // that placing the photos takes on all cores
    const head = entryHead(store, entry);
    const pictures = gallery(entry.entry);
    const seen = checks(
      entry.entry,
      (marks) => pictures.mark(marks),
      (taken) => {
        seconds = taken;
        tellTime();
      },
    );
    const line = errorLine();
    const job = jobPlace(store, entry.entry, ["sfm"], { main: true });
    const matcher = h(
      "select",
      { id: "matcher" },
      MATCHERS.map(([value, text]) => h("option", { value }, text)),
    );
    const frames = h("input", { id: "frames", type: "number", min: 3, max: 5000, inputmode: "numeric" });
    const exact = h("input", { type: "checkbox" });
    const find = h("button", { "data-own": "" }, "Place the photos");
    const next = h("p", { class: "next", hidden: true });
    const form = h(
      "form",
      {
        id: "find",
        "data-next": `sfm ${entry.entry}`,
        onchange: () => tellTime(),
        onsubmit: (event) => {
          event.preventDefault();
          attempt(find, line, () => {
            const options = {
              matcher: matcher.value || null,
              frames: entry.videos && frames.value ? Number(frames.value) : null,
              threads: exact.checked ? 1 : null,
            };
            return startJob(store, { command: "sfm", subject: entry.entry, options });
          });
        },
      },
      find,
      h(
        "details",
        {},
        h("summary", {}, "More"),
        h("p", { class: "row" }, h("label", { for: "matcher" }, "Compare"), matcher),
        h("p", { class: "row", hidden: !entry.videos }, h("label", { for: "frames" }, "Frames of the video"), frames),
        h("label", { class: "check" }, exact, " the same poses to the bit every time (one thread, slower)"),
      ),
    );

    // Tells the next step how long it takes; nothing is known of a video, and little of a single thread.
    function tellTime() {
      form.dataset.takes = seconds && !exact.checked ? `takes roughly ${duration(seconds)}` : "";
      store.changed();
    }

    const add = entry.adopted ? null : intake(store, { kind: "photos", name: entry.name });
    const later = h(
      "div",
      { class: "later", hidden: true },
      add && [add.progress, add.element],
      management(store, entry),
    );
    const missing = h("div", {}); // the photos that its capture lacks
    stage.append(
      head.element,
      missing,
      h(
        "div",
        { class: "watch turned" },
        h(
          "section",
          { "aria-label": "cameras" },
          heading(2, "Cameras"),
          h("p", {}, "The first step finds where each photo was taken. Photos need to overlap."),
          form,
          line,
          job.element,
          next,
        ),
        h("div", {}, seen.element, pictures.element),
      ),
      later,
    );
    return {
      entry,
      take: add?.take,
      close: () => seen.close(),
      update(now) {
        job.update();
        head.update(now);
        pictures.read(now).then(
          () => (later.hidden = false),
          (error) => put(line, error.message),
        );
        if (now.photos) seen.read(now);
        form.hidden = Boolean(job.view?.active);
        const made = store.madeBy(job.view);
        if (made) {
          const open = want(
            "a",
            { href: addressOf(made), class: "button" },
            `See where the photos were taken: ${made.name}`,
          );
          patch(next, open, " ", want("span", {}, searchOf(made)));
          patch(missing, unplaced(made, entry.entry));
        }
        next.hidden = !made;
        find.textContent = made ? "Place the photos again" : "Place the photos";
      },
    };
  });
}

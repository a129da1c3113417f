// The part of a screen that asks the doctor.

import { at, get } from "./api.js";
import { attempt, button, errorLine, h, heading, patch, versioned, want } from "./dom.js";
import { showFindings } from "./gallery.js";
import { jobPlace, startJob } from "./jobs.js";

const AGAIN = { left: "Train again without what is left out", masked: "Train again with the masks" };

// marked(marks) gets the names of findings by photo; left(photo, out) is called when one of them was left out or taken back.
export function doctor(store, entry, hint, marked = () => {}, left = () => {}) {
  const line = errorLine();
  const found = h("div", { class: "found" });
  const job = jobPlace(store, entry, ["doctor"]);
  const ask = button("Examine", () => attempt(ask, line, () => startJob(store, { command: "doctor", subject: entry })));
  const again = h("p", { class: "row", hidden: true });
  let [request, answer] = [null, null];

  // After photos were left out or masked, a run is trained again without them.
  const kinds = new Set();
  function noted(kind) {
    store.refresh();
    if (!request || kinds.has(kind)) return;
    kinds.add(kind);
    const label = kinds.size > 1 ? "Train again with these changes" : AGAIN[kind];
    patch(again, offer({ label, request }));
    again.hidden = false;
  }

  const show = () => showFindings(found, offer, heard, answer);

  // Notes what has become of a photo, given by its path, in each finding that means it.
  function note(list, path, is) {
    for (const finding of answer.findings)
      finding.photos?.forEach((one, index) => {
        if (one === path) finding[list][index] = is;
      });
    show();
  }

  const heard = {
    store,
    line: errorLine(),
    left(path, photo, out) {
      note("left_out", path, out);
      left(photo, out);
      noted("left");
    },
    drawn(path, is) {
      note("masked", path, is);
      noted("masked");
    },
  };

  function offer({ label, request: asked, place }) {
    if (place) return want("a", { href: place, class: "button" }, label);
    const onclick = ({ currentTarget }) =>
      attempt(currentTarget, line, async () => {
        const { job: begun } = await startJob(store, { ...asked, begun: { by: label, at: entry } });
        await store.refresh();
        location.hash = `#/${begun.subject.split("/").map(encodeURIComponent).join("/")}`;
      });
    return want("button", { type: "button", onclick }, label);
  }

  const findings = versioned(
    line,
    () => get(at(entry, "findings")),
    (now) => {
      answer = now;
      request = now.again;
      marked(show());
    },
  );

  return {
    element: h(
      "section",
      { "aria-label": "doctor" },
      heading(2, "Doctor"),
      h("p", { class: "quiet" }, hint),
      ask,
      line,
      job.element,
      again,
      found,
    ),
    update(now) {
      job.update();
      const view = job.view;
      job.element.hidden = !view || view.job.state === "done"; // then the findings say everything
      ask.textContent = view ? "Examine again" : "Examine";
      ask.hidden = Boolean(view?.active);
      const version = `${view?.job.id} ${view?.job.state} ${now.modified}`;
      findings.read(version); // before anyone examines a capture, what is certain about it
    },
  };
}

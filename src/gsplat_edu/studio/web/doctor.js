// The part of a screen that asks the doctor.

import { at, get } from "./api.js";
import { attempt, button, errorLine, h, heading } from "./dom.js";
import { showFindings } from "./gallery.js";
import { jobPlace, startJob } from "./jobs.js";

// marked(marks) gets the names of findings by photo.
export function doctor(store, entry, hint, marked = () => {}) {
  const line = errorLine();
  const found = h("div", { class: "found" });
  const job = jobPlace(store, entry, ["doctor"]);
  const ask = button("Examine", () =>
    attempt(ask, line, () => startJob(store, { command: "doctor", subject: entry })),
  );
  let read = "";

  return {
    element: h("section", { "aria-label": "doctor" }, heading(2, "Doctor"), h("p", { class: "quiet" }, hint), ask, line, job.element, found),
    update(now) {
      job.update();
      const view = job.view;
      job.element.hidden = !view || view.job.state === "done"; // then the findings say everything
      ask.textContent = view ? "Examine again" : "Examine";
      ask.hidden = Boolean(view?.active);
      const version = `${view?.job.id} ${view?.job.state} ${now.modified}`;
      if (!view || version === read) return;
      read = version;
      get(at(entry, "findings")).then(
        (answer) => version === read && marked(showFindings(found, answer)),
        (error) => (line.hidden = !(line.textContent = error.message)),
      );
    },
  };
}

// A training as it runs: the scene, how far it is, and its curves. Also the view of a finished scene.

import { at, get, getQuietly, head } from "./api.js";
import { decibels, duration, h, heading, link, patch, put, want, whole } from "./dom.js";
import { verdictOf } from "./judge.js";
import { curve } from "./curves.js";
import { beside, frame } from "./frame.js";
import { jobPlace, waitsFor } from "./jobs.js";
import { addressOf } from "./entries.js";

const EVERY = 2000; // milliseconds between two looks at the curves
const REFRESH = 5; // looks at the curves between two looks at the library

// The page of a scene as exports have it: with the saved edits, unless they do not fit it or are switched off.
function edited(store, entry) {
  const box = h("input", { type: "checkbox", checked: true, onchange: () => store.changed() });
  const label = h("label", { class: "check", hidden: true }, box, " with the saved edits");
  const note = h("p", { class: "notice", hidden: true });
  let [asked, refused] = ["", ""];
  return {
    element: h("div", {}, label, note),
    address(now) {
      const plain = at(entry.entry, "page");
      const address = `${plain}?edited=1&of=${now.modified}`;
      label.hidden = !now.edited;
      if (!now.edited || !box.checked) return plain;
      if (asked !== address) {
        [asked, refused] = [address, ""];
        head(address).catch(({ status, message }) => {
          if (status !== 400 || asked !== address) return; // the frame asks again
          refused = message;
          store.changed();
        });
      }
      put(note, refused && `The saved edits are not shown. ${refused}`);
      return refused ? plain : address;
    },
  };
}

// The screen of a scene without a training.
export function look({ place, store, entry }) {
  const scene = frame(`scene ${entry.name}`);
  const page = edited(store, entry);
  place.append(scene.element, h("div", { class: "row" }, scene.full), page.element);
  return {
    close: () => scene.close(),
    update(now) {
      scene.cover(now);
      scene.show(page.address(now));
    },
  };
}

export function watch({ place, store, entry }) {
  const scene = frame(`scene of ${entry.name}`);
  const captureOf = () => {
    return store.captureOf(entryNow());
  };
  const entryNow = () => store.entry("runs", entry.name) ?? entry;
  const slider = beside(scene, captureOf);
  const page = edited(store, entry);
  const job = jobPlace(store, entry.entry, ["train"], { main: true, level: 2 });
  const figures = h("dl", { class: "figures-list card" });
  const curves = {
    loss: curve("Loss", (value) => value.toPrecision(3)),
    psnr: curve("PSNR", decibels),
    count: curve("Splats", whole),
  };
  const next = h("p", { class: "next row" });
  const verdict = h("div"); // how good the scene is, in words
  place.append(
    h(
      "div",
      { class: "watch" },
      h("div", { class: "left-side" }, scene.element, slider.element, page.element),
      h("div", { class: "right-side" }, verdict, next, figures, job.element),
    ),
    h(
      "section",
      { "aria-label": "curves" },
      heading(2, "Curves"),
      h(
        "div",
        { class: "curves" },
        Object.values(curves).map(({ element }) => element),
      ),
    ),
  );
  const data = { points: [[], [], []], scores: [[], []], live: [[], []], next: "" };
  let [busy, again] = [false, false];

  async function readCurves() {
    again = busy; // the end of a training may come while an earlier answer is on its way
    if (busy || !entryNow().files) return;
    busy = true;
    try {
      let more = true;
      while (more) {
        const found = await get(`${at(entry.entry, "curves")}?after=${encodeURIComponent(data.next)}`);
        if (found.reset) Object.assign(data, { points: [[], [], []], scores: [[], []] });
        const { points, scores } = found;
        [points.iteration, points.loss, points.num_gaussians].forEach((some, i) => data.points[i].push(...some));
        [scores.iteration, scores.psnr].forEach((some, i) => data.scores[i].push(...some));
        more = found.more && found.next !== data.next;
        data.next = found.next;
      }
      if (job.view?.active) {
        const state = await getQuietly(at(entry.entry, "live", "state"));
        if (state?.history) data.live = [state.history.iteration, state.history.psnr];
      }
    } catch {
      // the folder of a new run is not there yet
    } finally {
      busy = false;
    }
    const { iterations, psnr, planned } = entryNow();
    const end = job.view?.active ? planned : 0; // the axis does not count along
    curves.loss.show(data.points[0], data.points[1], "", end);
    curves.count.show(data.points[0], data.points[2], "", end);
    if (data.scores[0].length > 1) curves.psnr.show(...data.scores, "of held-out views", end);
    else if (data.live[0].length) curves.psnr.show(...data.live, "of training photos", end);
    else if (psnr !== null) curves.psnr.show([iterations], [psnr], "of held-out views", end);
    if (again) readCurves();
  }

  let seen = null;
  let ticks = 0;
  const timer = setInterval(() => {
    if (!job.view?.active) return;
    readCurves();
    if (++ticks % REFRESH === 0) store.refreshSoon();
  }, EVERY);

  return {
    close() {
      clearInterval(timer);
      slider.close();
      scene.close();
    },
    update(now) {
      job.update();
      const { view } = job;
      const active = Boolean(view?.active);
      const phase = `${active} ${now.files > 0} ${now.iterations}`;
      if (phase !== seen) {
        seen = phase;
        readCurves();
      }
      const waits = waitsFor(view);
      page.element.hidden = active;
      scene.cover(now.finished && !active ? now : captureOf());
      if (active && view.job.state !== "queued" && now.files) scene.show(at(entry.entry, "live", "page"), waits);
      else if (active) scene.show(null, waits);
      else if (now.files) scene.show(page.address(now));
      else scene.show(null, "There is no scene.");
      showFigures(figures, now, view, data);
      patch(verdict, active ? [] : verdictOf(now));
      if (now.finished && !active && !next.children.length) {
        next.append(link("Judge it", `${addressOf(now)}/judge`, { class: "button" }));
      }
    },
  };
}

function showFigures(list, now, view, { points }) {
  const training = view?.active && /train/.test(view.progress?.stage ?? "") ? view.progress : null;
  const done = training?.done ?? now.iterations ?? 0; // of the job's bar, which has the time left as well
  const splats = (view?.active && points[2].at(-1)) || now.num_gaussians;
  const rows = [
    ["iterations", now.planned ? `${whole(done)} of ${whole(now.planned)}` : "–"],
    ["splats", splats ? whole(splats) : "–"],
    ["time", now.seconds ? duration(now.seconds) : "–"],
  ];
  patch(
    list,
    rows.map(([name, value]) => want("div", {}, want("dt", {}, name), want("dd", {}, value))),
  );
}

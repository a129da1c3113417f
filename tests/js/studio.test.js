import assert from "node:assert/strict";
import { test } from "node:test";

// Modules of the page listen to the window's events, which node does not have.
const events = new EventTarget();
globalThis.addEventListener = events.addEventListener.bind(events);

const { leftOf, startJob, waitsFor } = await import("../../src/gsplat_edu/studio/web/jobs.js");
const { bytes } = await import("../../src/gsplat_edu/viewer/web/words.js");
const { dayOf, namedByDay } = await import("../../src/gsplat_edu/studio/web/intake.js");
const { Store } = await import("../../src/gsplat_edu/studio/web/store.js");

const JOB = { id: "1", title: "training of a", subject: "runs/a", command: "", state: "running", waits_for: [] };

// What the card of a job says of the time left after each of some events.
function said(all) {
  const work = { command: "train", inputs: ["captures/a"], outputs: ["runs/a"], options: {} };
  const view = new Store().put({ ...JOB, work });
  return all.map((event, i) => {
    view.take({ ...event, number: i + 1 });
    return view.progress ? leftOf(view.progress, view.stages.length > 1) : "";
  });
}

// Events of a stage: its forecasts of the time left, s, at equal steps.
function stageOf(stage, ...left) {
  const steps = left.map((seconds, done) => ({
    event: "progress",
    stage,
    done,
    total: left.length,
    seconds_left: seconds,
  }));
  return [{ event: "stage", name: stage }, ...steps];
}

function secondsIn(text) {
  const [, hours, number, unit] = text.match(/(?:(\d+) h )?(\d+) (s|min) left/);
  return (60 * Number(hours ?? 0) + Number(number)) * (unit === "s" ? 1 : 60);
}

test("a size has two digits or a whole number, and never a thousand of a unit", () => {
  const said = [0, 999, 1000, 9949, 99_400, 99_500, 99_960, 112_000, 999_499, 999_500, 1e6, 65.4e9, 5e15].map(bytes);
  const [small, large] = [
    ["0 B", "999 B", "1.0 kB", "9.9 kB", "99 kB"],
    ["1.0 MB", "1.0 MB", "65 GB", "5000 TB"],
  ];
  assert.deepEqual(said, [...small, "100 kB", "100 kB", "112 kB", "999 kB", ...large]);
});

test("the time left never rises in a stage", () => {
  // densification makes iterations slower than the pace of the first ones; one forecast is missing
  const texts = said(stageOf("training", 50, 40, 42, 90, 100, null, 80, 39, 20, 21, 19, 3)).slice(1);
  assert.deepEqual(texts.map(secondsIn), [50, 40, 40, 40, 40, 40, 40, 39, 20, 20, 19, 3]);
  // a forecast that is clearly larger makes the figure a least time
  const least = texts.flatMap((text, i) => (text.includes("at least") ? [i] : []));
  assert.deepEqual(least, [3, 4, 5, 6]);
});

test("another stage or attempt has a time of its own", () => {
  const texts = said([
    ...stageOf("matching", 10, 5),
    ...stageOf("training", 600, 500),
    { event: "started" },
    ...stageOf("training", 700, 650),
  ]).filter((text) => text.includes("left"));
  assert.deepEqual(texts.map(secondsIn), [10, 5, 600, 480, 720, 660]); // minutes are rounded
});

test("a new job with the id of a removed one is known before the stream tells of it", async () => {
  const store = new Store();
  store.heard.set("000007", 3); // of the removed job
  globalThis.fetch = async () => Response.json({ id: "000007", state: "queued", subject: "runs/a" });
  assert.equal((await startJob(store, {})).job.state, "queued");
});

test("before the first picture, a training says what it works on", () => {
  const work = { command: "train", inputs: ["captures/a"], outputs: ["runs/a"], options: {} };
  const view = new Store().put({ ...JOB, work });
  assert.equal(waitsFor(view), "The training is starting.");
  view.take({ number: 1, event: "stage", name: "reading photos" });
  view.take({ number: 2, event: "progress", stage: "reading photos", done: 5, total: 20, seconds_left: null });
  assert.equal(waitsFor(view), "The picture comes with the training. First: reading photos, 25 %.");
  view.job.state = "queued";
  assert.equal(waitsFor(view), "This training waits for other jobs.");
});

test("what to do while the studio is gone is its whole command", async () => {
  const start = "gsplat-edu studio '/home/me/my library' --port 8091";
  globalThis.fetch = async () => Response.json({ trouble: [], start });
  const store = new Store();
  await store.refresh();
  globalThis.fetch = async () => Promise.reject(new TypeError("failed"));
  await store.refresh();
  assert.match(store.trouble, /^The studio does not answer\. .* this command and open the address that it prints: /);
  assert.ok(store.trouble.endsWith(start));
  globalThis.fetch = async () => new Response("403 Forbidden: open the URL, including its token", { status: 403 });
  await store.refresh();
  assert.match(store.trouble, /^The studio was started again\. Open the address/);
});

test("an older answer about the library does not replace a newer one", async () => {
  const answers = [];
  globalThis.fetch = () => new Promise((resolve) => answers.push(resolve));
  const store = new Store();
  const refreshed = [store.refresh(), store.refresh()];
  for (const [i, folder] of [
    [1, "newer"],
    [0, "older"],
  ]) {
    answers[i](Response.json({ trouble: [], folder }));
    await refreshed[i];
  }
  assert.equal(store.library.folder, "newer");
});

test("photos without a folder are named by the day they were taken", async () => {
  const photo = (text, name) => new File([text], name, { lastModified: new Date(2025, 0, 2, 12).getTime() });
  const edited = photo("\xff\xd8 2026:06:01 09:00:00\0 2026:05:14 23:59:59\0", "IMG_10.jpg");
  assert.deepEqual(await dayOf(edited), new Date(2026, 4, 14));
  const plain = photo("2026:05:14 is no date of EXIF, nor 2026:13:01 00:00:00\0", "IMG_9.png");
  assert.equal((await dayOf(plain)).getFullYear(), 2025);
  const named = [edited, plain].map((file) => ({ file, path: file.name }));
  assert.equal(await namedByDay(named), "Photos of 2 January 2025"); // 9 comes before 10
  assert.equal(await namedByDay(named.slice(0, 1)), "Photos of 14 May 2026");
});

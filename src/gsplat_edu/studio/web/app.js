// The page: which screen the address names, keys, and what every screen shares.

import { keepPresses } from "../../viewer/web/patch.js";
import { gone } from "./api.js";
import { announce, keptFocus, patch, put } from "./dom.js";
import { Store } from "./store.js";
import { home } from "./home.js";
import { trash } from "./trash.js";
import { photos } from "./photos.js";
import { capture } from "./capture.js";
import { run, scene } from "./tabs.js";
import { jobs } from "./jobs.js";

const SCREENS = { "": home, photos, captures: capture, runs: run, scenes: scene, jobs, trash };
const store = new Store();
const main = document.getElementById("main");
const keys = document.getElementById("keys");
const keepFocus = keptFocus();
let shown = null;

// "#/runs/NAME/judge?view=3" as {kind, name, tab, more, query}.
export function place() {
  const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
  const parts = path.split("/").map((part) => {
    try {
      return decodeURIComponent(part);
    } catch {
      return part;
    }
  });
  const [kind = "", name = "", tab = "", more = ""] = parts;
  return { kind, name, tab, more, query: new URLSearchParams(query) };
}

function route() {
  const where = place();
  if (shown?.follows?.(where)) return; // the screen shows another part of itself
  shown?.close?.();
  patch(main);
  shown = (SCREENS[where.kind] ?? home)({ main, store, where });
  update();
  for (const item of document.querySelectorAll("header nav a")) {
    const jobsShown = where.kind === "jobs";
    const current = (item.hash === "#/jobs") === jobsShown;
    if (current) item.setAttribute("aria-current", jobsShown || where.kind === "" ? "page" : "true");
    else item.removeAttribute("aria-current");
  }
  const title = main.querySelector("h1")?.textContent ?? "";
  document.title = title ? `${title} – gsplat-edu studio` : "gsplat-edu studio";
  if (route.moved) {
    main.focus({ preventScroll: true });
    scrollTo(0, 0);
    announce(title);
  }
  route.moved = true;
}

function update() {
  const lost = store.connected === false ? gone() : "";
  put(document.getElementById("trouble"), store.trouble || lost);
  const active = [...store.jobs.values()].filter(({ active }) => active).length;
  put(document.getElementById("job-count"), active ? String(active) : "");
  shown?.update?.();
  keepFocus();
}

// Files are dropped anywhere. The screen that is shown takes them in, or else home does.
function onDrag(event) {
  event.preventDefault(); // a dropped file must not open
  const { type, dataTransfer, relatedTarget } = event;
  const holdsFiles = Boolean(dataTransfer?.types.includes("Files"));
  const isOver = holdsFiles && (type === "dragover" || (type === "dragleave" && relatedTarget));
  document.body.classList.toggle("dropping", Boolean(isOver));
  if (type !== "drop" || !holdsFiles) return;
  if (!shown.take) {
    history.pushState(null, "", "#/");
    route();
  }
  shown.take(dataTransfer);
}

// Many events come at once; one picture needs one update.
let asked = false;
store.addEventListener("change", ({ detail }) => {
  tell(detail.job);
  if (asked) return;
  asked = true;
  nextFrame().then(() => {
    asked = false;
    update();
  });
});

const nextFrame = () =>
  new Promise((resolve) => {
    requestAnimationFrame(resolve);
    setTimeout(resolve, 500); // hidden tabs get no frames
  });

// Says to screen readers when a job begins, ends, or has done another quarter of a stage.
const announced = new Map();
function tell(id) {
  const view = store.jobs.get(id);
  if (!view) return;
  const { job, progress, stage } = view;
  const quarter = progress?.total ? Math.floor((4 * progress.done) / progress.total) : 0;
  const text = job.state === "running" && stage ? `${stage} ${25 * quarter} %` : job.state;
  if (announced.has(id) && announced.get(id) !== text) announce(`${job.title}: ${text}`);
  announced.set(id, text);
}

const usesKeys = () => localStorage.getItem("keys") !== "off";

function onKey(event) {
  const typing = event.target.closest?.(
    "input:not([type=checkbox], [type=radio], [type=range]), select, textarea, dialog",
  );
  if (event.ctrlKey || event.metaKey || event.altKey || typing || !usesKeys()) return;
  const actions = {
    "?": () => keys.showModal(),
    l: () => (location.hash = "#/"),
    j: () => (location.hash = "#/jobs"),
    u: () => main.querySelector("[data-key-u]")?.click(),
    p: () => main.querySelector("[data-key-p]:not([hidden])")?.click(),
  };
  const tab = /^[1-4]$/.test(event.key) && main.querySelectorAll(".tabs a")[Number(event.key) - 1];
  const action = tab ? () => tab.click() : actions[event.key.toLowerCase()];
  if (!action) return;
  event.preventDefault();
  action();
}

function start() {
  keepPresses();
  if (location.search) history.replaceState(null, "", `/${location.hash}`); // the token is a secret; a cookie has it now
  const setting = document.getElementById("keys-on");
  setting.checked = usesKeys();
  setting.addEventListener("change", () => localStorage.setItem("keys", setting.checked ? "on" : "off"));
  document.getElementById("keys-button").addEventListener("click", () => keys.showModal());
  document.querySelector(".skip").addEventListener("click", (event) => {
    event.preventDefault(); // the address names the screen
    main.focus();
  });
  addEventListener("keydown", onKey);
  addEventListener("hashchange", route);
  addEventListener("focus", () => store.refreshSoon());
  for (const type of ["dragover", "dragleave", "drop"]) addEventListener(type, onDrag);
  route();
  store.refresh();
  store.readJobs().catch(() => {}); // the stream says when to read them again
  store.connect();
}

start();

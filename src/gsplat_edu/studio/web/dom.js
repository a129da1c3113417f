// Elements and the words on them. Text always becomes text nodes, so that a name like <b> is shown as it is.

import { h, patch, want } from "../../viewer/web/patch.js";
import { bytes, count, duration, whole } from "../../viewer/web/words.js";

export { bytes, count, duration, h, patch, want, whole };

export const button = (text, onclick, more = {}) => h("button", { type: "button", onclick, ...more }, text);

export const link = (text, href, more = {}) => h("a", { href, ...more }, text);

export const heading = (level, text, more = {}) => h(`h${level}`, more, text);

// An icon by its name, for patch() and h(); see gsplat_edu/base/icons.py.
export const icon = (name) =>
  want("svg", { class: "icon", "aria-hidden": "true" }, want("use", { href: `/base/web/icons.svg#icon-${name}` }));

const TONES = Object.entries({
  busy: ["queued", "running", "paused", "stopping"],
  good: ["done"],
  fair: ["held", "cancelled", "warning"],
  poor: ["failed", "interrupted", "damaged", "fatal"],
});

// A badge in the colour of a job's state or a finding's severity, for patch().
export function toned(state, text) {
  const [tone] = TONES.find(([, states]) => states.includes(state)) ?? [""];
  return want("span", { class: `badge ${tone}` }, text);
}

// Shows a text, or hides the element if there is none. Screen readers hear the same text only once.
export function put(element, text) {
  patch(element, text);
  element.hidden = !text;
}

// How long ago a time (s since 1970) was, in words; a date beyond a week.
export function age(time) {
  const seconds = Math.max(0, Date.now() / 1000 - time);
  const days = Math.floor(seconds / 86400);
  if (seconds < 60) return "just now";
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ago`;
  if (days < 1) return `${Math.floor(seconds / 3600)} h ago`;
  if (days < 8) return `${count(days, "day")} ago`;
  return dateOf(new Date(1000 * time));
}

// "14 May 2026", in the place's own time.
export const dateOf = (date) => date.toLocaleDateString("en-GB", { day: "numeric", month: "long", year: "numeric" });

// What a training takes, in words: one quality of a forecast.
export const forecastText = ({ seconds, bytes: memory, gaussians, iterations }) =>
  `about ${duration(seconds)}, ${bytes(memory)} of memory; ${whole(iterations)} iterations, up to ${whole(gaussians)} splats`;

export const decibels = (value) => (typeof value === "number" ? `${value.toFixed(2)} dB` : "–");

// Says something to screen readers.
export function announce(text) {
  document.getElementById("status").textContent = text;
}

// The words of a command line and a button that copies them, for patch() and h().
export function commandLine(command) {
  const attributes = { tabindex: "0", role: "textbox", "aria-readonly": "true", "aria-label": "command" };
  const onclick = async ({ currentTarget: copy }) => {
    try {
      await navigator.clipboard.writeText(command);
      copy.textContent = "Copied";
      announce("Copied the command");
    } catch {
      getSelection().selectAllChildren(copy.previousSibling); // without permission, the user presses Ctrl-C
      copy.textContent = "Selected";
    }
    setTimeout(() => (copy.textContent = "Copy"), 2000);
  };
  return want(
    "div",
    { class: "command" },
    want("code", attributes, command),
    want("button", { type: "button", class: "copy", onclick }, "Copy"),
  );
}

// A line about an error, next to what it is about.
export const errorLine = () => h("p", { class: "error", role: "alert", hidden: true });

// Asks before something that cannot be undone; resolves to whether the person agreed.
export function agreed(question, line, yes) {
  const dialog = h(
    "dialog",
    { "aria-labelledby": "agree-title" },
    heading(2, question, { id: "agree-title" }),
    h("p", {}, line),
    h(
      "form",
      { method: "dialog", class: "actions" },
      h("button", { value: "", autofocus: true }, "Cancel"),
      h("button", { value: "yes", class: "danger" }, yes),
    ),
  );
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) =>
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "yes");
    }),
  );
}

// Runs what a button does; shows its error in a line, and keeps the button from being pressed twice.
export async function attempt(pressed, line, act) {
  if (pressed) pressed.disabled = true;
  put(line, "");
  try {
    return await act();
  } catch (error) {
    put(line, error.message);
    return undefined;
  } finally {
    if (pressed) pressed.disabled = false;
    if (pressed?.isConnected && document.activeElement === document.body) pressed.focus({ preventScroll: true });
  }
}

// Asks for what a version of the page shows, once for each version; an answer that comes after the question of a newer
// version is dropped. If the studio did not answer, the next change asks again. after() comes after the answer or its error.
export function versioned(line, ask, show, after = () => {}) {
  let [asked, failed] = [null, false];
  return {
    read(version) {
      if (version === asked) return;
      asked = version;
      ask().then(
        (answer) => {
          if (version !== asked) return;
          if (failed) put(line, "");
          failed = false;
          show(answer);
          after();
        },
        (error) => {
          if (version !== asked) return;
          if (error.status === 0) asked = null;
          failed = true;
          put(line, error.message);
          after();
        },
      );
    },
  };
}

// Keeps the keyboard's place: returns a function to call after each change of the page. If what had the focus is gone or
// hidden by then, what is nearest to it gets the focus.
export function keptFocus() {
  let chain = []; // what had the focus last, and what it lies in
  addEventListener("focusin", ({ target }) => {
    chain = [];
    for (let at = target; at; at = at.parentElement) chain.push(at);
  });
  return () => {
    const [last] = chain;
    if (!last || document.activeElement !== document.body || (last.isConnected && last.checkVisibility())) return;
    for (const place of chain.slice(1)) {
      if (!place.isConnected || !place.checkVisibility()) continue;
      const near = [...place.querySelectorAll("button, a, input, select, summary")];
      const next = near.find((one) => one.checkVisibility() && !one.disabled);
      if (next) return next.focus({ preventScroll: true });
    }
  };
}

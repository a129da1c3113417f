// Elements and the words on them. Text always becomes text nodes, so that a name like <b> is shown as it is.

const SVG = "http://www.w3.org/2000/svg";
const SVG_NAMES = new Set(["svg", "path", "line", "text", "title", "g", "circle"]);

// Makes an element. Attributes that are functions are listeners; null, undefined and false leave an attribute out.
export function h(name, attributes = {}, ...children) {
  const made = SVG_NAMES.has(name) ? document.createElementNS(SVG, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "function") made.addEventListener(key.replace(/^on/, ""), value);
    else if (value === true) made.setAttribute(key, "");
    else if (value !== null && value !== undefined && value !== false) made.setAttribute(key, value);
  }
  made.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return made;
}

export const button = (text, onclick, more = {}) => h("button", { type: "button", onclick, ...more }, text);

export const link = (text, href, more = {}) => h("a", { href, ...more }, text);

export const heading = (level, text, more = {}) => h(`h${level}`, more, text);

// Shows a text, or hides the element if there is none. Screen readers hear the same text only once.
export function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
  element.hidden = !text;
}

// Makes the children of a container those of a list: `make(item)` for new keys, `update(child, item)` for all. The focus
// stays where it is, although what is moved loses it.
export function keyed(container, items, keyOf, make, update = () => {}) {
  const focused = document.activeElement;
  const old = new Map([...container.children].map((child) => [child.dataset.key, child]));
  const kept = new Set(items.map((item) => String(keyOf(item))));
  for (const [key, child] of old) if (!kept.has(key)) child.remove(); // first, so that the others need not be moved
  items.forEach((item, index) => {
    const key = String(keyOf(item));
    let child = old.get(key);
    old.delete(key);
    if (!child) {
      child = make(item);
      child.dataset.key = key;
    }
    update(child, item);
    if (container.children[index] !== child) container.insertBefore(child, container.children[index] ?? null);
  });
  if (document.activeElement !== focused && container.contains(focused)) focused.focus({ preventScroll: true });
}

// Replaces what is in a place. The control that takes the place of the one with the focus gets it, and what was unfolded
// stays so.
export function renew(place, ...children) {
  const all = (kind) => [...place.querySelectorAll(kind)];
  const controls = "button, a, summary";
  const focused = all(controls).indexOf(document.activeElement);
  const unfolded = all("details").map(({ open }) => open);
  place.replaceChildren(...children);
  all("details").forEach((one, index) => (one.open = Boolean(unfolded[index])));
  all(controls)[focused]?.focus({ preventScroll: true });
}

export const count = (number, one, many = `${one}s`) => `${whole(number)} ${number === 1 ? one : many}`;

export const whole = (number) => Math.round(number).toLocaleString("en");

export function bytes(number) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let [value, unit] = [number, 0];
  while (value >= 1000 && unit < units.length - 1) [value, unit] = [value / 1000, unit + 1];
  return `${unit && value < 100 ? value.toPrecision(2) : Math.round(value)} ${units[unit]}`;
}

export function duration(seconds) {
  if (seconds < 60) return `${Math.max(1, Math.round(seconds))} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

// What a training takes, in words: one quality of a forecast.
export const forecastText = ({ seconds, bytes: memory, gaussians, iterations }) =>
  `about ${duration(seconds)}, ${bytes(memory)} of memory; ${whole(iterations)} iterations, up to ${whole(gaussians)} splats`;

export const decibels = (value) => (typeof value === "number" ? `${value.toFixed(2)} dB` : "–");

// Says something to screen readers.
export function announce(text) {
  document.getElementById("status").textContent = text;
}

// The words of a command line and a button that copies them.
export function commandLine(command) {
  const text = h("code", { tabindex: "0", role: "textbox", "aria-readonly": "true", "aria-label": "command" }, command);
  const copy = button("Copy", async () => {
    try {
      await navigator.clipboard.writeText(command);
      copy.textContent = "Copied";
      announce("Copied the command");
    } catch {
      getSelection().selectAllChildren(text); // without permission, the user presses Ctrl-C
      copy.textContent = "Selected";
    }
    setTimeout(() => (copy.textContent = "Copy"), 2000);
  });
  copy.className = "copy";
  return h("div", { class: "command" }, text, copy);
}

// A line about an error, next to what it is about.
export const errorLine = () => h("p", { class: "error", role: "alert", hidden: true });

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
    forget: () => (asked = null),
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

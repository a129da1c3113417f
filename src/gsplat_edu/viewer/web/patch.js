// Elements, and the renderer that changes a place of a page to what it should contain. The nodes that are there stay: with
// them what is pressed, the focus, the selection, and what the user has unfolded or typed. The studio's pages use it too.

const SVG = "http://www.w3.org/2000/svg";
const SVG_NAMES = new Set(["svg", "path", "line", "polyline", "text", "title", "g", "circle", "use"]);
const CONTROL = "button, a, summary, label, input, select, textarea";
const PRESSABLE = "button, a, summary, label, [type=checkbox], [type=radio]"; // not what is dragged, or opens a list

const shown = new WeakMap(); // what each element made here was made or changed to
let pressed = null; // {control, box, attributes} from a press until its click

// A description of an element. Attributes on... that are functions are listeners; null, undefined and false leave an
// attribute out. Children are texts, descriptions and elements, also in lists; the same three leave a child out.
export const want = (name, attributes = {}, ...children) => ({ name, attributes, children });

// An element that the caller keeps: where it is wanted, it stays itself.
export const h = (...described) => made({ ...want(...described), own: true });

// Changes the children of a place to those that are wanted. An element among them stands for itself. A description is
// shown by the child that was made for one with its name and data-key; by the next such child without a key. Only what
// differs between two descriptions is changed, so what the user or other code sets stays, and the content of elements that
// stand for themselves is theirs.
export function patch(place, ...children) {
  const wanted = listed(children);
  const present = [...place.childNodes];
  const order = counterparts(wanted.map(idOf), present.map(idOfNode));
  const holders = [pressed?.control, document.activeElement].filter((one) => one && place.contains(one));
  const stay = staying(
    order,
    holders.map((one) => present.findIndex((child) => child.contains(one))),
  );
  const still = new Set(order);
  present.forEach((child, at) => still.has(at) || child.remove());
  let next = null;
  for (let i = wanted.length - 1; i >= 0; --i) {
    const node = order[i] < 0 ? made(wanted[i]) : changed(present[order[i]], wanted[i]);
    if (!stay.has(order[i])) place.insertBefore(node, next);
    next = node;
  }
}

const listed = (children) => children.flat(Infinity).filter((child) => ![null, undefined, false, ""].includes(child));

const isDescription = (wanted) => typeof wanted === "object" && !(wanted instanceof Node);

const idOf = (wanted) => {
  if (isDescription(wanted)) return `${wanted.name} ${wanted.attributes["data-key"] ?? ""}`;
  return typeof wanted === "object" ? wanted : "";
};

const idOfNode = (node) => {
  if (node.nodeType === Node.TEXT_NODE) return "";
  const described = shown.get(node);
  return described && !described.own ? idOf(described) : node;
};

// Index of the present child for each wanted one, by their ids; -1 for new ones.
export function counterparts(wanted, present) {
  const free = new Map(present.map((id) => [id, []]));
  present.forEach((id, at) => free.get(id).push(at));
  return wanted.map((id) => free.get(id)?.shift() ?? -1);
}

// Indices of the present children that stay in their place while the others are moved around them: as many as possible,
// but among them the pinned ones; the first pin, if two cannot both stay. order: what counterparts() gives.
export function staying(order, pins = []) {
  let rest = order.map((at, to) => ({ at, to })).filter(({ at }) => at >= 0);
  for (const pin of pins) {
    const held = rest.find(({ at }) => at === pin);
    if (held) rest = rest.filter((one) => one === held || one.at < pin === one.to < held.to);
  }
  const ends = []; // of the increasing sequences of 1, 2, ... indices, that with the lowest end
  for (const { at } of rest) {
    let [low, high] = [0, ends.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (ends[middle].at < at) low = middle + 1;
      else high = middle;
    }
    ends[low] = { at, before: ends[low - 1] };
  }
  const found = new Set();
  for (let one = ends.at(-1); one; one = one.before) found.add(one.at);
  return found;
}

function made(wanted) {
  if (!isDescription(wanted)) return typeof wanted === "object" ? wanted : document.createTextNode(wanted);
  const { name, attributes, children } = wanted;
  const element = SVG_NAMES.has(name) ? document.createElementNS(SVG, name) : document.createElement(name);
  dress(element, {}, attributes);
  shown.set(element, wanted);
  element.append(...listed(children).map(made));
  return element;
}

function changed(node, wanted) {
  if (isDescription(wanted)) {
    dress(node, shown.get(node).attributes, wanted.attributes);
    shown.set(node, wanted);
    patch(node, wanted.children);
  } else if (node !== wanted && node.data !== String(wanted)) node.data = wanted;
  return node;
}

function dress(element, before, after) {
  for (const key of Object.keys({ ...before, ...after })) {
    const value = after[key];
    if (value === before[key]) continue;
    if (typeof value === "function") element.addEventListener(key.slice(2), LISTENER);
    else if (value === null || value === undefined || value === false) element.removeAttribute(key);
    else element.setAttribute(key, value === true ? "" : value);
    if (key in before && ["value", "checked"].includes(key)) element[key] = value; // the attribute is the first one only
  }
}

// The one listener of all elements: each calls what it was last described with; a click, what it was pressed with.
const LISTENER = {
  handleEvent(event) {
    const { currentTarget: element, type } = event;
    const isPress = type === "click" && pressed?.control === element;
    return (isPress ? pressed : shown.get(element)).attributes[`on${type}`]?.(event);
  },
};

function press(target) {
  const control = target.closest?.(CONTROL);
  if (!control?.matches(PRESSABLE)) return null;
  const { attributes } = shown.get(control) ?? {};
  return { control, box: control.getBoundingClientRect(), attributes };
}

// Makes a press count for the control that was pressed, although it moves away from the pointer before the release: it
// captures the pointer. As ever, a release beside it is no click; it may be where the control was, or where it is.
export function keepPresses() {
  const listen = (type, hear) => addEventListener(type, hear, true);
  listen("pointerdown", ({ target, isPrimary, button, pointerId }) => {
    pressed = isPrimary && button === 0 ? press(target) : null;
    pressed?.control.setPointerCapture(pointerId);
  });
  listen("pointercancel", () => (pressed = null));
  listen("keydown", ({ target, key, repeat }) => {
    if (!repeat) pressed = key === " " ? press(target) : null;
  });
  listen("click", (event) => {
    const { target, isTrusted, detail, pointerType, clientX: x, clientY: y } = event;
    const held = pressed;
    if (!held || held.clicked || !isTrusted) return;
    held.clicked = true; // a label clicks its field, too
    setTimeout(() => pressed === held && (pressed = null)); // after the listeners
    const covers = ({ left, right, top, bottom }) => left <= x && x <= right && top <= y && y <= bottom;
    const isThere = [held.box, held.control.getBoundingClientRect()].some(covers);
    const counts = !detail || pointerType === "touch" || isThere; // a finger that moves makes no click
    if (counts && held.control.contains(target)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (counts) held.control.click(); // Chromium clicks what is under a finger now
  });
}

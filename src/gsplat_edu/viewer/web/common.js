// What the pages of scenes and of captures share: elements, the message, lists, and shader programs.

import { keepPresses, patch, want } from "./patch.js";

export const element = (id) => document.getElementById(id);

// An icon, for patch(), by the address of its symbol in the page, such as "#icon-close".
export const icon = (href) => want("svg", { class: "icon", "aria-hidden": "true" }, want("use", { href }));

export function say(text) {
  element("message").textContent = text;
  element("message").classList.remove("waiting");
  element("unpacking")?.remove();
  element("message").hidden = !text;
}

export function fail(error) {
  say(error?.message || String(error));
}

export const hasSize = ({ clientWidth, clientHeight }) => clientWidth > 0 && clientHeight > 0;

// Calls back whenever the size of an element changes, or how many pixels the screen has for it. Resolves once it has a
// size: in a frame that is hidden it has none.
export function followSize(place, resized) {
  const measured = () => [place.clientWidth, place.clientHeight, devicePixelRatio].join();
  let last = measured();
  return new Promise((resolve) => {
    const look = () => {
      if (!hasSize(place)) return;
      if (measured() !== last) resized();
      last = measured();
      resolve();
    };
    new ResizeObserver(look).observe(place);
    addEventListener("resize", look); // another screen
  });
}

// Runs what makes the page once it is there, and shows the reason if that, or anything later, fails.
export function startPage(start) {
  addEventListener("error", (event) => fail(event.error));
  addEventListener("unhandledrejection", (event) => fail(event.reason));
  keepPresses();
  addEventListener("DOMContentLoaded", () => start().catch(fail));
}

// Changes the items of a list. If the one with the keyboard's focus is gone, the last button gets it; in an empty list it
// goes elsewhere.
export function refill(list, items, elsewhere) {
  const isIn = list.contains(document.activeElement);
  patch(list, items);
  if (isIn && !list.contains(document.activeElement))
    ([...list.querySelectorAll("button")].at(-1) ?? elsewhere).focus();
}

// The controls of a panel, which a button hides and shows. Until somebody presses the button, they are hidden in a window that
// matches the media query `small`, because the picture has the room first, and shown in any other.
export class Fold {
  constructor(small) {
    const query = matchMedia(small);
    const follow = () => this.hide(query.matches);
    query.addEventListener("change", follow);
    element("fold").addEventListener("click", () => {
      query.removeEventListener("change", follow);
      this.hide(!element("tools").hidden);
    });
    follow();
  }

  hide(away) {
    element("tools").hidden = away;
    element("fold").setAttribute("aria-expanded", !away);
  }
}

// A program of the shaders whose texts the page has under NAME.vert and NAME.frag.
export function linked(gl, name) {
  const program = gl.createProgram();
  for (const [stage, type] of [
    ["vert", gl.VERTEX_SHADER],
    ["frag", gl.FRAGMENT_SHADER],
  ]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, document.getElementById(`${name}.${stage}`).textContent.trim());
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    const log = gl.getShaderInfoLog(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`${name}.${stage}: ${log}`);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`${name}: ${gl.getProgramInfoLog(program)}`);
  return program;
}

export function nearestTexture(gl) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  for (const [name, value] of [
    [gl.TEXTURE_MIN_FILTER, gl.NEAREST],
    [gl.TEXTURE_MAG_FILTER, gl.NEAREST],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE],
    [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
  ]) {
    gl.texParameteri(gl.TEXTURE_2D, name, value);
  }
  return texture;
}

// What the pages of scenes and of captures share: elements, the message, lists, and shader programs.

export const element = (id) => document.getElementById(id);

export function say(text) {
  element("message").textContent = text;
  element("message").hidden = !text;
}

export function fail(error) {
  say(error?.message || String(error));
}

// Runs what makes the page once it is there, and shows the reason if that, or anything later, fails.
export function startPage(start) {
  addEventListener("error", (event) => fail(event.error));
  addEventListener("unhandledrejection", (event) => fail(event.reason));
  addEventListener("DOMContentLoaded", () => start().catch(fail));
}

// Replaces the items of a list. The keyboard's focus stays at its place in it; in an empty list it goes elsewhere.
export function refill(list, items, elsewhere) {
  const at = [...list.querySelectorAll("button")].indexOf(document.activeElement);
  list.replaceChildren(...items);
  if (at < 0) return;
  const buttons = list.querySelectorAll("button");
  (buttons[Math.min(at, buttons.length - 1)] ?? elsewhere).focus();
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

// What the pages of scenes and of captures share: elements, the message, lists, and shader programs.
"use strict";

const element = (id) => document.getElementById(id);

function say(text) {
  element("message").textContent = text;
  element("message").hidden = !text;
}

// Replaces the items of a list. The keyboard's focus stays at its place in it; in an empty list it goes elsewhere.
function refill(list, items, elsewhere) {
  const at = [...list.querySelectorAll("button")].indexOf(document.activeElement);
  list.replaceChildren(...items);
  if (at < 0) return;
  const buttons = list.querySelectorAll("button");
  (buttons[Math.min(at, buttons.length - 1)] ?? elsewhere).focus();
}

// A program of the shaders whose texts the page has under NAME.vert and NAME.frag.
function linked(gl, name) {
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

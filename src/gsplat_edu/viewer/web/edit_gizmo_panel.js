// The part of the editor's panel that belongs to the handle: its buttons for the keyboard, and angles as numbers.

import { element } from "./common.js";
import { anglesOfRows, degrees, orthonormal, product3, rowsOfAngles } from "./edit_rotations.js";
import { radians, transposed } from "./vectors.js";

// The parts in the order in which the key goes through them.
export const GIZMO_PARTS = [
  ...["x", "y", "z"].map((name, axis) => ({ kind: "arrow", axis, name: `move ${name}` })),
  ...["x", "y", "z"].map((name, axis) => ({ kind: "ring", axis, name: `turn ${name}` })),
  { kind: "middle", axis: 0, name: "move freely" },
];

const GIZMO_PANEL = `
<p class="row" role="group" aria-label="part of the handle that the arrow keys move">
${GIZMO_PARTS.map(({ name }) => `<button data-handle="${name}">${name}</button>`).join("\n")}
</p>
<p class="row numbers" id="edit-angles" role="group" aria-label="turned, degrees"><span>turned, degrees: tilt, heading, roll</span></p>
<p class="row" data-for="box"><button id="edit-level-box">level the box again</button></p>`;

// Adds three fields for numbers, x, y and z, to an element; returns them.
export function numberFields(id) {
  return ["x", "y", "z"].map((axis) => {
    const label = document.createElement("label");
    const input = document.createElement("input");
    Object.assign(input, { type: "number", step: "any" });
    label.append(`${axis} `, input);
    element(id).append(label);
    return input;
  });
}

export class GizmoPanel {
  constructor(gizmo) {
    this.gizmo = gizmo;
    this.root = element("edit-handle");
    this.root.insertAdjacentHTML("beforeend", GIZMO_PANEL);
    this.angles = numberFields("edit-angles");
    this.root.addEventListener("click", ({ target }) => this.click(target.closest("button")));
    this.root.addEventListener("input", ({ target }) => this.input(target));
  }

  click(button) {
    if (button?.dataset.handle) this.gizmo.choose(button.dataset.handle);
    else if (button?.id === "edit-level-box") this.setAngles([0, this.shown()[1], 0]);
  }

  // The angles of the shape relative to an upright one, radians.
  shown() {
    const { gizmo } = this;
    const { upright, shape } = gizmo;
    const turn = product3(transposed(upright), shape.rotation);
    return anglesOfRows(gizmo.tools.tool === "box" ? turn : product3(turn, upright));
  }

  setAngles(angles) {
    const { gizmo } = this;
    const { upright } = gizmo;
    const turn = product3(upright, rowsOfAngles(angles));
    const rotation = orthonormal(gizmo.tools.tool === "box" ? turn : product3(turn, transposed(upright)));
    gizmo.take({ ...gizmo.shape, rotation });
    gizmo.editor.changed();
  }

  input(field) {
    const index = this.angles.indexOf(field);
    const value = Number(field.value);
    if (index < 0 || !this.gizmo.shape?.rotation || field.value === "" || !Number.isFinite(value)) return;
    this.setAngles(this.shown().map((old, i) => (i === index ? radians(value) : old)));
  }

  update() {
    const { shape, chosen } = this.gizmo;
    const names = this.gizmo.parts().map(({ name }) => name);
    for (const button of this.root.querySelectorAll("[data-handle]")) {
      button.setAttribute("aria-pressed", button.dataset.handle === chosen?.name);
      button.hidden = !names.includes(button.dataset.handle);
      button.disabled = !shape;
    }
    element("edit-angles").hidden = !shape?.rotation;
    element("edit-level-box").disabled = !shape;
    const angles = shape?.rotation ? this.shown() : [];
    this.angles.forEach((input, i) => {
      if (input !== document.activeElement) input.value = angles.length ? Number(degrees(angles[i]).toFixed(2)) : "";
    });
  }
}

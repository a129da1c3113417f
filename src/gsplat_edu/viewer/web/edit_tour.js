// The order of the named views, and the guided tour as a visitor of the exported page walks through it.

import { element, icon } from "./common.js";
import { Guide } from "./guide.js";
import { readKeyframe } from "./keyframes.js";

export const TOUR_ROW = `
<p class="row"><button data-do="tour" aria-pressed="false" title="Walk through the guided tour as a visitor does; ← → are its steps, Escape ends it">preview the tour</button></p>`;

export class EditTour {
  constructor(editor) {
    const { viewer, panel } = editor;
    Object.assign(this, { editor, viewer });
    this.guide = viewer.guide = new Guide(viewer, panel.button("tour"), []);
    this.guide.onToggle = (on) => this.toggled(on);
  }

  // The named views have changed; a tour that is on stays at its step.
  follow(views) {
    const { guide, viewer } = this;
    const named = [...views.named.values()].filter(({ text }) => text);
    const at = guide.steps[guide.at]?.name;
    guide.steps = named.map((view) => ({
      name: view.name,
      text: view.text,
      camera: viewer.keyframes.camera(readKeyframe(view)),
      index: -1,
    }));
    guide.button.textContent = `preview the tour (${named.length})`;
    guide.button.disabled = !named.length;
    if (!guide.on) return;
    if (!named.length) return guide.close();
    const still = guide.steps.findIndex(({ name }) => name === at);
    return guide.show(still < 0 ? Math.min(guide.at, named.length - 1) : still);
  }

  // A visitor sees neither the selection nor what tools draw.
  toggled(on) {
    document.body.classList.toggle("touring", on);
    if (on) this.editor.tools.choose("navigate");
    this.editor.look.hide(on);
  }

  // Buttons that move a view within the list of names.
  buttons(name, names, button) {
    const at = names.indexOf(name);
    return [
      ["#icon-up", "earlier", -1],
      ["#icon-down", "later", 1],
    ].map(([href, when, by]) => {
      const more = { "data-order": `${when} ${name}`, "aria-disabled": String(names[at + by] === undefined) };
      return button(icon(href), `${name} ${when}`, () => this.move(names, at, by, when), more);
    });
  }

  move(names, at, by, when) {
    if (names[at + by] === undefined) return;
    const order = [...names];
    [order[at], order[at + by]] = [order[at + by], order[at]];
    this.editor.perform({ op: "order_views", names: order });
    const buttons = [...element("edit-views").querySelectorAll("[data-order]")];
    buttons.find(({ dataset }) => dataset.order === `${when} ${names[at]}`)?.focus();
  }
}

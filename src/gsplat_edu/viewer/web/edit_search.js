// Finds an action of the editor's page by its name, and presses its button (Ctrl K).

import { element } from "./common.js";
import { patch, want } from "./patch.js";

const MOST_FOUND = 9;

const SEARCH_DIALOG = `
<dialog id="edit-search" aria-label="find an action">
<input role="combobox" aria-label="find an action" aria-expanded="true" aria-controls="edit-found" autocomplete="off" placeholder="What do you want to do?">
<ol id="edit-found" role="listbox" aria-label="actions"></ol>
<p hidden>No action has these words.</p>
</dialog>`;

export class EditSearch {
  constructor(root) {
    root.insertAdjacentHTML("beforeend", SEARCH_DIALOG);
    this.dialog = element("edit-search");
    this.field = this.dialog.querySelector("input");
    this.field.addEventListener("input", () => this.list(0));
    this.dialog.addEventListener("keydown", (event) => this.key(event));
    this.dialog.addEventListener("click", ({ target }) => this.clicked(target));
  }

  open() {
    if (this.dialog.open) return;
    this.actions = availableActions();
    this.field.value = "";
    this.dialog.showModal();
    this.list(0);
  }

  // Lists the actions that have every word of the field, and marks one.
  list(at) {
    const words = this.field.value.toLowerCase().split(/\s+/);
    this.found = this.actions
      .filter(({ words: text }) => words.every((word) => text.includes(word)))
      .slice(0, MOST_FOUND);
    this.at = Math.min(Math.max(at, 0), this.found.length - 1);
    const rows = this.found.map(({ name, what, key }, i) =>
      want(
        "li",
        {
          id: `edit-found-${i}`,
          role: "option",
          "aria-selected": String(i === this.at),
        },
        want("span", {}, name),
        want("small", {}, what),
        key && want("kbd", {}, key),
      ),
    );
    patch(element("edit-found"), rows);
    this.dialog.querySelector("p").hidden = this.found.length > 0;
    this.field.setAttribute("aria-activedescendant", this.found.length ? `edit-found-${this.at}` : "");
  }

  key(event) {
    event.stopPropagation(); // the page's keys rest
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (step) this.list(this.at + step);
    else if (event.key === "Enter" && this.found[this.at]) this.press(this.found[this.at].button);
    else if (event.key === "Escape") this.close();
    else return;
    event.preventDefault();
  }

  clicked(target) {
    const row = target.closest("li");
    if (row) this.press(this.found[[...row.parentElement.children].indexOf(row)].button);
    else if (target === this.dialog) this.close(); // beside it
  }

  press(button) {
    this.close();
    button.click();
  }

  close() {
    this.field.blur(); // a closed dialog keeps the focus until the next frame
    this.dialog.close();
  }
}

// The buttons of the page that can be pressed now. A title is "KEY: what it does", or "what it does (KEY)".
function availableActions() {
  const buttons = document.querySelectorAll("#edit button, #bar button, #tools button");
  return [...buttons]
    .filter((button) => !button.disabled && !button.closest("ol, dialog, [hidden]:not(#tools)"))
    .map((button) => {
      const [, first, what, last] = /^(?:([^:]{1,14}): )?(.*?)(?: \(([^)]{1,3})\))?$/.exec(button.title);
      const name = button.textContent.trim() || button.getAttribute("aria-label");
      return { button, name, what, key: first ?? last, words: `${name} ${what}`.toLowerCase() };
    });
}

// What can be chosen for a training beside its quality, in plain words. An empty value leaves the choice to the program.

import { button, h } from "./dom.js";
import { GROUPS } from "./questions.js"; // made by the server from the options of the command

const INPUTS = {
  number: { type: "number", min: 1, inputmode: "numeric" },
  text: { type: "text", autocomplete: "off" },
  either: { type: "text", autocomplete: "off" },
};

// The value of a field as the request has it; the server says what is wrong with one.
function asked(kind, value) {
  if (kind === "switch") return value === "true";
  const isNumber = kind === "number" || (kind === "either" && Number.isFinite(Number(value)));
  return isNumber ? Number(value) : value;
}

const DETAIL = {
  none: "No box is drawn, so all that the photos show is learned.",
  drawn:
    "The rest of the photos does not count: what is in the box gets more detail, and the rest of the scene is left over.",
};

// Whether only the box of the capture is learned; draw() shows where to draw it.
function detail(draw) {
  const box = h("input", { id: "region", type: "checkbox", "aria-describedby": "region-hint" });
  const hint = h("span", { class: "quiet", id: "region-hint" });
  const go = button("Draw the box", draw);
  const element = h(
    "fieldset",
    { class: "group" },
    h("legend", {}, "What matters"),
    h("label", { class: "row" }, box, "Learn only what is in the box"),
    h("div", { class: "row" }, hint, go),
  );
  function drawn(is) {
    box.checked = is;
    box.disabled = !is;
    hint.textContent = is ? DETAIL.drawn : DETAIL.none;
    go.textContent = is ? "Change the box" : "Draw the box";
  }
  drawn(false);
  return { element, drawn, everywhere: () => !box.disabled && !box.checked };
}

// The fields of a training. `options()` gives what they ask for beside the quality; `resolution()` the size of the photos.
export function choices(draw) {
  const fields = {};
  const where = detail(draw);
  const field = ({ name, label, words, kind, example }) => {
    const id = name.replaceAll("_", "-");
    const attributes = { id, "aria-label": label };
    fields[name] = words.length
      ? h(
          "select",
          attributes,
          words.map(([value, meaning]) => h("option", { value }, meaning)),
        )
      : h("input", { ...attributes, ...INPUTS[kind], placeholder: example });
    return fields[name];
  };
  const groups = GROUPS.map(({ title, questions }) =>
    h(
      "fieldset",
      { class: "group" },
      h("legend", {}, title),
      h(
        "div",
        { class: "grid" },
        questions.map((question) => h("label", {}, question.label, field(question))),
      ),
    ),
  );
  return {
    element: [...groups, where.element],
    resolution: () => fields.resolution.value,
    drawn: where.drawn, // whether the capture has a box
    everywhere: where.everywhere, // whether the capture's box is ignored
    // A number of iterations, a time and another recipe take the place of a quality.
    options(quality) {
      const own = ["iterations", "time_limit", "strategy"].some((key) => fields[key].value);
      const found = own ? {} : { quality };
      if (where.everywhere()) found.set = { region: "none" };
      for (const { name, kind } of GROUPS.flatMap(({ questions }) => questions)) {
        const { value } = fields[name];
        if (value) found[name] = asked(kind, value);
      }
      return found;
    },
  };
}

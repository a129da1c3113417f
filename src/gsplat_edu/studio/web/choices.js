// What can be chosen for a training beside its quality, in plain words. An empty value leaves the choice to the program.

import { button, h } from "./dom.js";

const NUMBER_OR_AUTO = "auto|[0-9]+([.][0-9]+)?";

const number = (label, max) => ({ label, attributes: { type: "number", min: 1, max, inputmode: "numeric" } });
const text = (label, placeholder, more = {}) => ({
  label,
  attributes: { type: "text", autocomplete: "off", placeholder, ...more },
});
const choice = (label, ...choices) => ({ label, choices });

const GROUPS = [
  [
    "Length and size",
    {
      iterations: number("Iterations instead of a quality", 1000000),
      time_limit: text("Time instead of a quality", "30m"),
      resolution: text("Size of the photos: 2 for half, longest side in px, or auto", "full size", {
        pattern: NUMBER_OR_AUTO,
      }),
      max_memory: text("Memory limit", "8G"),
      max_gaussians: number("Splats at most"),
      strategy: choice(
        "Recipe",
        ["", "the fast one"],
        ["mcmc", "MCMC: random moves, needs a number of splats"],
        ["adc", "the one of 2023, 30,000 iterations"],
      ),
    },
  ],
  [
    "What the photos are like",
    {
      appearance: choice(
        "Brightness",
        ["", "decide from the photos"],
        ["exposure", "even out brightness and colour"],
        ["vignetting", "even out dark corners too"],
        ["none", "keep as photographed"],
      ),
      refine: choice(
        "Poses",
        ["", "as they are"],
        ["auto", "correct what held-out photos confirm"],
        ["poses", "correct the poses"],
        ["both", "correct poses and focal lengths"],
      ),
      lens: choice(
        "Lens",
        ["", "straighten the photos"],
        ["auto", "keep wide lenses, panoramas, rolling shutters"],
        ["native", "keep every lens as it is"],
      ),
      transients: choice("What moved between the photos", ["", "keep it"], ["mask", "leave it out"]),
      sky: choice(
        "Sky",
        ["", "decide from the photos"],
        ["shell", "put it far away"],
        ["none", "treat it like the rest"],
      ),
      outside_masks: choice(
        "Outside of the photos' masks",
        ["", "decide from the masks"],
        ["empty", "empty: the masks cut out an object"],
        ["ignore", "ignore: the masks hide something in front"],
      ),
    },
  ],
  [
    "What the scene is for",
    {
      surface: choice("Purpose", ["", "to look at"], ["surface", "for a mesh: learn surfaces"]),
      depth: choice(
        "Depth to learn from",
        ["", "none"],
        ["points", "the points that photos share"],
        ["capture", "the capture's own depth maps"],
      ),
    },
  ],
];

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
  const field = (key, { label, choices: values, attributes }) => {
    const id = key.replaceAll("_", "-");
    fields[key] = values
      ? h(
          "select",
          { id, "aria-label": label },
          values.map(([value, words]) => h("option", { value }, words)),
        )
      : h("input", { id, "aria-label": label, ...attributes });
    return fields[key];
  };
  const groups = GROUPS.map(([title, group]) =>
    h(
      "fieldset",
      { class: "group" },
      h("legend", {}, title),
      h(
        "div",
        { class: "grid" },
        Object.entries(group).map(([key, what]) => h("label", {}, what.label, field(key, what))),
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
      for (const [key, { type, value }] of Object.entries(fields)) {
        if (!value) continue;
        const numeric = type === "number" || (key === "resolution" && value !== "auto");
        found[key] = key === "surface" || (numeric ? Number(value) : value);
      }
      return found;
    },
  };
}

// Three small drawings of how to walk around what is photographed, seen from above.

import { h } from "./dom.js";

const CAMERA = "M0 0 -5 -11H5Z"; // the tip is the lens, from which its view opens

const seen = (d) => h("path", { d, class: "seen" });
const way = (d) => h("path", { d, class: "way" });

// A camera at a place of the drawing that looks along a direction, both given in the drawing's units and degrees.
const camera = ([x, y], turn) =>
  h("path", { d: CAMERA, class: "lens", transform: `translate(${x} ${y}) rotate(${turn})` });

// Cameras on an ellipse around the middle that look inwards.
const around = (rx, ry, number) =>
  Array.from({ length: number }, (_, i) => {
    const angle = (2 * Math.PI * (i + 0.5)) / number;
    const [x, y] = [80 + rx * Math.cos(angle), 60 + ry * Math.sin(angle)];
    return camera([x.toFixed(1), y.toFixed(1)], ((Math.atan2(60 - y, 80 - x) * 180) / Math.PI + 90).toFixed(1));
  });

const ellipse = (rx, ry) => `M${80 - rx} 60a${rx} ${ry} 0 1 0 ${2 * rx} 0a${rx} ${ry} 0 1 0 ${-2 * rx} 0Z`;

const drawing = (...parts) => h("svg", { viewBox: "0 0 160 120", "aria-hidden": "true" }, ...parts);

const thing = () =>
  drawing(way(ellipse(34, 34)), way(ellipse(52, 52)), seen(ellipse(11, 11)), around(34, 34, 7), around(52, 52, 10));

const room = () => {
  const stands = [
    [44, 36, 125],
    [80, 32, 170],
    [116, 36, 235],
    [122, 60, 275],
    [116, 84, 305],
    [80, 88, 350],
    [44, 84, 55],
    [38, 60, 95],
  ];
  return drawing(
    seen("M18 12H142V108H18Z M24 18V102H136V18Z"),
    way("M38 32H122V88H38Z"),
    ...stands.map(([x, y, turn]) => camera([x, y], turn)),
  );
};

const house = () =>
  drawing(
    way(ellipse(60, 46)),
    seen("M56 40H104V80H56Z M56 60H104M56 40 66 60 56 80M104 40 94 60 104 80"),
    around(60, 46, 12),
  );

const WALKS = [
  ["A thing", thing, "Walk around it twice: once level with it, once from higher up."],
  ["A room", room, "Walk along the walls and look across, never turn on the spot."],
  ["A house", house, "Walk all around it, far enough away to see two sides from each corner."],
];

export const walks = () =>
  h(
    "ul",
    { class: "walks", "aria-label": "how to take the photos" },
    WALKS.map(([title, draw, line]) =>
      h("li", { class: "card" }, draw(), h("h3", {}, title), h("p", { class: "small quiet" }, line)),
    ),
  );

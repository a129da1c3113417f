// The cameras of a capture: the lines that draw them, their colours, and which one is under the pointer.

import { dot, plus } from "./vectors.js";

const GRASP = 8; // CSS px: a line this near to the pointer is under it
const MOST_FINDINGS = 6; // with colours of their own; further ones share the last
const THIN = 1.5; // width of a line, CSS px
const THICK = 3.5; // of the chosen camera's lines
export const BYTES = 8; // per line: RGBA, width in quarters of a px, whether it grows with the outlines, and two unused

export class Cameras {
  constructor({ cameras, shapes, size, gap }) {
    this.list = cameras.map((camera) => ({ ...camera, marks: [...camera.marks] }));
    this.shapes = shapes;
    this.scale = size;
    this.base = size;
    this.chosen = -1;
    this.over = -1;
    this.firsts = []; // first line of each camera
    const numbers = [];
    this.list.forEach((camera) => {
      this.firsts.push(numbers.length / 9);
      for (const line of shapes[camera.shape].lines) {
        numbers.push(...camera.eye, ...inWorld(camera, line.slice(0, 3)), ...inWorld(camera, line.slice(3)));
      }
    });
    this.path = numbers.length / 9; // the first line of the path, which follows the cameras
    const way = (a, b) => numbers.push(...a, 0, 0, 0, ...plus(b, a, -1));
    this.list.slice(1).forEach(({ eye }, i) => way(this.list[i].eye, eye));
    this.arc = numbers.length / 9; // the first line of the arc without a camera
    (gap ?? []).slice(1).forEach((point, i) => way(gap[i], point));
    this.lines = new Float32Array(numbers);
    this.count = numbers.length / 9;
    this.styles = new Uint8Array(BYTES * this.count);
  }

  // The kinds of cameras in the order of the legend: {kind, name, cameras}. Left-out photos are a kind of their own.
  kinds() {
    const kinds = new Map();
    const add = (kind, name) => kinds.set(name, { kind, name, cameras: (kinds.get(name)?.cameras ?? 0) + 1 });
    const names = [...new Set(this.list.flatMap(({ marks }) => marks))];
    const number = new Map(names.map((name, i) => [name, `series-${Math.min(i + 1, MOST_FINDINGS)}`]));
    this.kindOf = ({ left_out: out, marks }) => (out ? "out" : marks.length ? number.get(marks[0]) : "camera");
    for (const camera of this.list) {
      const kind = this.kindOf(camera);
      add(kind, kind === "out" ? "left out" : kind === "camera" ? "photo" : camera.marks[0]);
    }
    const order = ["camera", ...[...number.values()], "out"];
    return [...kinds.values()].sort((a, b) => order.indexOf(a.kind) - order.indexOf(b.kind));
  }

  // Gives every line its colour and width; `colors` returns [R, G, B] of a kind.
  paint(colors, showsPath) {
    this.kinds();
    this.list.forEach((camera, i) => {
      const stands = i === this.chosen || i === this.over;
      const color = i === this.chosen ? colors("chosen") : colors(this.kindOf(camera));
      this.style(
        this.firsts[i],
        this.firsts[i + 1] ?? this.path,
        color,
        camera.left_out && !stands ? 140 : 255,
        stands ? THICK : THIN,
        true,
      );
    });
    this.style(this.path, this.arc, colors("way"), showsPath ? 200 : 0, 1, false);
    this.style(this.arc, this.count, colors("gap"), 255, THICK, false);
  }

  style(from, to, color, opacity, width, grows) {
    for (let line = from; line < to; ++line)
      this.styles.set([...color, opacity, 4 * width, grows ? 1 : 0], BYTES * line);
  }

  // The camera whose outline is at a place (CSS px): the nearest of those whose image holds it or whose lines are close;
  // -1 if there is none. `shown` is the view's camera, in px of a canvas with `dense` of them per CSS px.
  at(x, y, shown, dense) {
    const [u, v] = [x * dense - 0.5, y * dense - 0.5];
    let [best, least] = [-1, Infinity];
    this.list.forEach((camera, i) => {
      const depth = depthOf(camera.eye, shown);
      const { outline, lines } = this.shapes[camera.shape];
      const reach = this.scale / Math.max(1e-12, Math.hypot(...plus(camera.eye, shown.eye, -1)) - this.scale);
      const middle = depth > 0 ? projected(camera.eye, shown) : null;
      // far from the pointer, whatever the shape
      if (
        middle &&
        reach > 0 &&
        reach < 1 &&
        Math.hypot(middle[0] - u, middle[1] - v) > 2 * reach * Math.max(shown.fx, shown.W) + GRASP * dense
      )
        return;
      const held = this.holds(camera, outline, shown, u, v);
      if (!held && !this.touches(camera, lines, shown, u, v, GRASP * dense)) return;
      const rank = Math.hypot(...plus(camera.eye, shown.eye, -1)) + (i === this.chosen ? 1e-9 : 0);
      if (rank < least) [best, least] = [i, rank];
    });
    return best;
  }

  // A point of a camera's outline, given in its axes, in the world.
  placed(camera, point) {
    return plus(camera.eye, inWorld(camera, point), this.scale);
  }

  // Whether a pixel is inside the image of a camera's outline, by the parity of crossings.
  holds(camera, outline, shown, u, v) {
    const corners = outline.map((point) => projected(this.placed(camera, point), shown));
    if (!corners.length || corners.includes(null)) return false;
    let inside = false;
    corners.forEach(([ax, ay], i) => {
      const [bx, by] = corners[(i + 1) % corners.length];
      if (ay > v !== by > v && u < ax + ((v - ay) / (by - ay)) * (bx - ax)) inside = !inside;
    });
    return inside;
  }

  touches(camera, lines, shown, u, v, most) {
    return lines.some((line) => {
      const [a, b] = [line.slice(0, 3), line.slice(3)].map((point) => projected(this.placed(camera, point), shown));
      return a && b && fromLine([u, v], a, b) < most;
    });
  }
}

// A direction of a camera's axes in the world's.
const inWorld = ({ R }, [x, y, z]) => [0, 1, 2].map((axis) => R[0][axis] * x + R[1][axis] * y + R[2][axis] * z);

const depthOf = (point, { R, eye }) => dot(R[2], plus(point, eye, -1));

// Column and row at which a camera sees a point; null behind it.
export function projected(point, { R, eye, fx, fy, cx, cy }) {
  const [x, y, z] = R.map((row) => dot(row, plus(point, eye, -1)));
  return z > 0 ? [(fx * x) / z + cx, (fy * y) / z + cy] : null;
}

// Distance of a place from a line between two others.
function fromLine([x, y], [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay];
  const share = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(ax + share * dx - x, ay + share * dy - y);
}

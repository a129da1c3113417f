// Which level of each region of a streamed SOG is shown: the coarsest everywhere first, then finer ones where the error
// on the screen is largest for the number of splats, as far as the budget of splats goes; the nearest are loaded first.
//
// A new level is written beside the old one, sorted, and only then shown in its place. So a picture is complete at any
// time, and at most `budget` splats are drawn. Memory for one more batch is reserved.

import { element, fail } from "./common.js";
import { Sorter } from "./sorter.js";
import { dot } from "./vectors.js";

const SLOT = 32; // splats per piece of texture memory
const BATCH = 65536; // most splats that are decoded and sorted at once, unless a run has more
const PHONE = 1e6; // budgets, in splats
const MODEST = 2e6; // up to 4 GB of memory
const USUAL = 4e6;
const OUTSIDE = 0.05; // weight of the error of a region outside the picture, to which the camera may turn

// Budget of this machine: a phone's is a million; no more than its textures hold.
export function machineBudget(gl, degree) {
  const phone = matchMedia("(pointer: coarse)").matches && !matchMedia("(any-pointer: fine)").matches;
  const usual = phone ? PHONE : (navigator.deviceMemory ?? 8) <= 4 ? MODEST : USUAL;
  const texels = gl.getParameter(gl.MAX_TEXTURE_SIZE) ** 2 / (degree + 1) ** 2;
  return Math.min(usual, Math.floor(texels / 2));
}

export class Levels {
  // onChange() is called when other splats are shown.
  constructor(facts, budget, onChange) {
    const { regions, filenames } = facts.lod;
    this.facts = facts;
    this.budget = budget;
    this.filenames = filenames;
    this.onChange = onChange;
    this.regions = regions.map((region) => ({
      ...region,
      levels: Object.keys(region.runs)
        .map(Number)
        .sort((a, b) => b - a), // coarsest first
      shown: -1, // level
      wanted: -1,
      slots: [],
    }));
    const largest = Math.max(0, ...regions.flatMap(({ runs }) => Object.values(runs).map((run) => run.count)));
    this.capacity = SLOT * (Math.ceil((budget + Math.max(BATCH, largest)) / SLOT) + 2 * regions.length);
    this.free = Array.from({ length: this.capacity / SLOT }, (_, i) => this.capacity / SLOT - 1 - i);
    this.count = 0; // shown
    this.most = 0; // shown at any time
    this.queue = Promise.resolve();
    this.chosen = "";
    this.stopped = false;
    const source = element("lod-worker").textContent;
    this.worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
  }

  attach(renderer, sorter) {
    [this.renderer, this.sorter] = [renderer, sorter];
  }

  size(region, level) {
    return level < 0 ? 0 : region.runs[level].count;
  }

  // Distance from a camera to a region's box.
  distance({ low, high }, eye) {
    const gaps = eye.map((x, i) => Math.max(low[i] - x, 0, x - high[i]));
    return Math.max(this.facts.near, Math.hypot(...gaps));
  }

  // Error of a level on the screen, in pixels per splat. A region is seen from half its own reach at least: the camera
  // may stand in its box, but not in all of its splats. Without errors, a guess by the distance between splats.
  error(region, level, camera) {
    const { low, high, errors } = region;
    const count = Math.max(1, this.size(region, level));
    const reach = Math.hypot(...low.map((x, i) => high[i] - x)) / 2;
    const guess = (reach / Math.cbrt(count)) * Number(level > 0);
    const weight = visible(region, camera, this.facts.near) ? 1 : OUTSIDE;
    const distance = Math.max(this.distance(region, camera.eye), reach / 2);
    return (weight * camera.fx * (errors.length ? errors[level] : guess)) / distance / count;
  }

  // Chooses a level for every region.
  choose(camera) {
    const key = Sorter.key(camera);
    if (key === this.chosen) return;
    this.chosen = key;
    const near = new Map(this.regions.map((region) => [region, this.distance(region, camera.eye)]));
    const order = this.regions.filter(({ levels }) => levels.length).sort((a, b) => near.get(a) - near.get(b));
    let left = this.budget;
    for (const region of order) {
      const coarsest = region.levels[0];
      region.wanted = this.size(region, coarsest) <= left ? coarsest : -1;
      left -= this.size(region, region.wanted);
    }
    const heap = order
      .filter(({ wanted }) => wanted >= 0)
      .map((region) => [this.error(region, region.wanted, camera), region]);
    heap.sort((a, b) => a[0] - b[0]); // the largest error comes last
    while (heap.length) {
      const [, region] = heap.pop();
      const finer = region.levels[region.levels.indexOf(region.wanted) + 1];
      if (finer === undefined) continue;
      const more = this.size(region, finer) - this.size(region, region.wanted);
      if (more > left) continue;
      left -= more;
      region.wanted = finer;
      const error = this.error(region, finer, camera);
      let [low, high] = [0, heap.length];
      while (low < high) {
        const middle = (low + high) >> 1;
        if (heap[middle][0] < error) low = middle + 1;
        else high = middle;
      }
      heap.splice(low, 0, [error, region]);
    }
  }

  // The next changes: regions, all in one file, and the level that each gets. Empty if all are as wanted.
  next(camera) {
    const near = (region) => this.distance(region, camera.eye);
    const open = this.regions.filter(({ shown, wanted }) => shown !== wanted);
    const nothing = open.filter(({ shown }) => shown < 0);
    const coarser = open.filter((region) => this.size(region, region.wanted) < this.size(region, region.shown));
    const finer = open.filter((region) => this.size(region, region.wanted) >= this.size(region, region.shown));
    // Nothing is left out, coarse first; room is made before it is needed.
    let [group, level] = [finer, ({ wanted }) => wanted];
    if (nothing.length) [group, level] = [nothing, ({ levels }) => levels[0]];
    if (group === finer && coarser.length) group = coarser;
    if (group === nothing && coarser.length && !this.fits(nothing, level))
      [group, level] = [coarser, ({ wanted }) => wanted];
    group.sort((a, b) => near(a) - near(b));
    const batch = [];
    let [file, total] = [null, 0];
    for (const region of group) {
      const to = level(region);
      const run = to < 0 ? { file: null, count: 0 } : region.runs[to];
      if (batch.length && (run.file !== file || total + run.count > BATCH)) continue;
      file = run.file;
      total += run.count;
      batch.push({ region, to });
    }
    return batch;
  }

  fits(group, level) {
    return this.count + group.reduce((sum, region) => sum + this.size(region, level(region)), 0) <= this.budget;
  }

  // Loads what is missing for a camera, until it is another one's turn. Calls for the same camera share the work.
  load(camera) {
    this.choose(camera);
    if (!this.loading) this.loading = this.loop().finally(() => (this.loading = null));
    this.camera = camera;
    return this.loading;
  }

  async loop() {
    for (;;) {
      await null; // `camera` is set
      const batch = this.next(this.camera);
      if (!batch.length || this.stopped) return;
      await this.change(batch);
    }
  }

  // Shows what is there, and asks for no more.
  fail(error) {
    this.stopped = true;
    fail(error);
  }

  // Replaces the levels of some regions, all from one file.
  async change(batch) {
    const runs = batch.filter(({ to }) => to >= 0).map(({ region, to }) => region.runs[to]);
    const parts = runs.length ? await this.decoded(this.filenames[runs[0].file], runs) : [];
    const old = [];
    for (const { region, to } of batch) {
      old.push(...region.slots);
      this.count += this.size(region, to) - this.size(region, region.shown);
      region.slots = to < 0 ? [] : this.write(parts.shift(), region.runs[to].count);
      region.shown = to;
    }
    for (const [begin, end] of stretches(old)) this.sorter.hide(SLOT * begin, SLOT * (end - begin));
    this.most = Math.max(this.most, this.count);
    await this.sorter.refresh();
    this.free.push(...old);
    this.free.sort((a, b) => b - a);
    this.onChange();
  }

  decoded(name, runs) {
    return new Promise((resolve, reject) => {
      this.worker.onerror = () => reject(new Error("The decoding thread failed; reload the page."));
      this.worker.onmessage = ({ data }) => (data.failed ? reject(new Error(data.failed)) : resolve(data.parts));
      this.worker.postMessage({ address: new URL(name, location.href).href, runs, degree: this.facts.sh_degree });
    });
  }

  // Writes splats into free slots, and returns these.
  write(part, count) {
    const slots = this.free.splice(this.free.length - Math.ceil(count / SLOT)).reverse();
    let from = 0;
    for (const [begin, end] of stretches(slots)) {
      const here = Math.min(count - from, SLOT * (end - begin));
      this.renderer.write(part, from, SLOT * begin, here);
      this.sorter.write(part.means.slice(3 * from, 3 * (from + here)), SLOT * begin);
      from += here;
    }
    return slots;
  }
}

// Whether a region's box may be in the picture: no side of it has all corners beyond.
function visible({ low, high }, camera, near) {
  const inside = [0, 0, 0, 0, 0]; // corners in front, and before the left, right, upper and lower side
  for (let corner = 0; corner < 8; ++corner) {
    const offset = low.map((x, i) => (corner & (1 << i) ? high[i] : x) - camera.eye[i]);
    const [x, y, z] = camera.R.map((axis) => dot(axis, offset));
    inside[0] += z > near;
    inside[1] += camera.fx * x + camera.cx * z >= 0;
    inside[2] += camera.fx * x + (camera.cx - camera.W) * z <= 0;
    inside[3] += camera.fy * y + camera.cy * z >= 0;
    inside[4] += camera.fy * y + (camera.cy - camera.H) * z <= 0;
  }
  return inside.every((count) => count > 0);
}

// Begin and end of each stretch of consecutive numbers, in their order.
function stretches(numbers) {
  const found = [];
  for (const number of numbers) {
    if (found.length && found.at(-1)[1] === number) ++found.at(-1)[1];
    else found.push([number, number + 1]);
  }
  return found;
}

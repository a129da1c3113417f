// How much is drawn while the view moves, so that a computer without a graphics processor keeps up.
//
// A whole picture of a large scene takes such a computer seconds. While the view moves, the page therefore draws fewer
// splats, a sample in which large ones are likelier, into a smaller image. Once the view rests, the whole picture is
// drawn in parts, so that the next movement never waits for it.

const FRAME = 100; // milliseconds that a frame may take while the view moves
const LATE_FRAMES = 2; // in a row that take longer, before less is drawn
const QUICK_FRAMES = 4; // in a row that take less than a third of it, before more is drawn
const PART = 60; // milliseconds that a part of a whole picture should take
const LEAST_PART = 2048; // splats
export const STILL = 200; // milliseconds without a movement until the whole picture is drawn

// From everything to very little; `share` is that of the width and of the height.
export const DETAILS = [
  { most: Infinity, share: 1 },
  { most: 400000, share: 0.5 },
  { most: 200000, share: 0.5 },
  { most: 100000, share: 0.5 },
  { most: 50000, share: 0.4 },
  { most: 25000, share: 1 / 3 },
  { most: 12000, share: 1 / 4 },
];

// What is drawn of a training that runs on the same processor.
export const SPARING = { most: 25000, share: 0.4 };

export class Pace {
  constructor() {
    this.level = 0; // of DETAILS
    this.quick = this.late = 0; // frames in a row
    this.part = LEAST_PART;
  }

  get detail() {
    return DETAILS[this.level];
  }

  // Whether the whole picture takes longer than a frame may.
  get slow() {
    return this.level > 0;
  }

  // Work of a picture, in splats: a third of it is by splat, the rest by pixel.
  static work({ most, share }, count) {
    return (Math.min(most, count) * (1 + 2 * share ** 2)) / 3;
  }

  // Chooses the detail for a scene, given how long a picture of some detail took.
  expect(milliseconds, detail, count) {
    const rate = milliseconds / Pace.work(detail, count);
    const fitting = DETAILS.findIndex((other) => rate * Pace.work(other, count) <= FRAME);
    this.level = fitting < 0 ? DETAILS.length - 1 : fitting;
    this.quick = this.late = 0;
  }

  // Adapts the detail to the time that a frame took.
  took(milliseconds, count) {
    this.late = milliseconds > FRAME ? this.late + 1 : 0;
    this.quick = milliseconds < FRAME / 3 ? this.quick + 1 : 0;
    if (this.late >= LATE_FRAMES) {
      const wanted = (Pace.work(this.detail, count) * FRAME) / milliseconds;
      while (this.level < DETAILS.length - 1 && Pace.work(this.detail, count) > wanted) ++this.level;
      this.late = 0;
    } else if (this.level && this.quick >= QUICK_FRAMES) [this.level, this.quick] = [this.level - 1, 0];
  }

  // Adapts the size of the parts of a whole picture.
  partTook(milliseconds) {
    const factor = Math.min(2, Math.max(0.5, PART / Math.max(1, milliseconds)));
    this.part = Math.max(LEAST_PART, Math.round(this.part * factor));
  }
}

// A camera with a share of the pixels of each side.
export function reduced(camera, share) {
  const [W, H] = [camera.W, camera.H].map((side) => Math.max(1, Math.round(share * side)));
  const [across, down] = [W / camera.W, H / camera.H];
  const [cx, cy] = [(camera.cx + 0.5) * across - 0.5, (camera.cy + 0.5) * down - 0.5];
  return { ...camera, fx: camera.fx * across, fy: camera.fy * down, cx, cy, W, H };
}

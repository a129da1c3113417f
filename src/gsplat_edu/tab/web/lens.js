// Lenses of photos, and photos as a pinhole camera would have taken them; the twin of gsplat_edu/data/lens.py.
//
// A lens is {W, H, fx, fy, cx, cy, coefficients}, in pixels; the centre of the first pixel is (0, 0). The coefficients are
// those of NAMES; all of them are zero for a pinhole. With x, y the direction of a ray, q = x² + y²:
//   s = (1 + k1 q + k2 q² + k3 q³) / (1 + k4 q + k5 q² + k6 q³)
//   a = s x + 2 p1 x y + p2 (q + 2 x²),   b = s y + p1 (q + 2 y²) + 2 p2 x y,   u = fx a + cx,   v = fy b + cy

import { CaptureError } from "./reading.js";

export const NAMES = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];

const RIM = 65; // points of each edge of a photo that are followed to find its pinhole
const NEWTON = 20;
const FOLD_GRID = 33;
const FOCAL_RANGE = 3; // largest factor by which undistortion may change the focal length
const STEEPEST = Math.tan((70 * Math.PI) / 180); // largest slope of the rays through the middle of an edge

export const distorts = (lens) => lens.coefficients.some((value) => value !== 0);

// Where the ray (x, y, 1) meets the image, in units of the focal length.
export function distorted([k1, k2, p1, p2, k3, k4, k5, k6], x, y) {
  const q = x * x + y * y;
  const s = (1 + q * (k1 + q * (k2 + q * k3))) / (1 + q * (k4 + q * (k5 + q * k6)));
  return [s * x + 2 * p1 * x * y + p2 * (q + 2 * x * x), s * y + p1 * (q + 2 * y * y) + 2 * p2 * x * y];
}

// Derivatives of the two coordinates of `distorted` after x and y, by central differences: [a_x, a_y, b_x, b_y].
function slopes(coefficients, x, y) {
  const h = 1e-6;
  const [right, left] = [distorted(coefficients, x + h, y), distorted(coefficients, x - h, y)];
  const [below, above] = [distorted(coefficients, x, y + h), distorted(coefficients, x, y - h)];
  return [right[0] - left[0], below[0] - above[0], right[1] - left[1], below[1] - above[1]].map((d) => d / (2 * h));
}

// The ray (x, y, 1) through a pixel, by Newton's method; NaN if it finds none.
export function rayOf(lens, u, v) {
  const [a, b] = [(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy];
  let [x, y] = [a, b];
  let [ea, eb] = [0, 0];
  for (let i = 0; i <= NEWTON; ++i) {
    const image = distorted(lens.coefficients, x, y);
    [ea, eb] = [image[0] - a, image[1] - b];
    const [ax, ay, bx, by] = slopes(lens.coefficients, x, y);
    const det = ax * by - ay * bx;
    x -= (by * ea - ay * eb) / det;
    y -= (ax * eb - bx * ea) / det;
  }
  return Math.hypot(ea, eb) < 1e-9 ? [x, y] : [Number.NaN, Number.NaN];
}

// The same camera with another number of pixels; the edges of the image stay where they are.
export function resized(lens, W, H) {
  const [x, y] = [W / lens.W, H / lens.H];
  const [cx, cy] = [(lens.cx + 0.5) * x - 0.5, (lens.cy + 0.5) * y - 0.5];
  return { ...lens, W, H, fx: lens.fx * x, fy: lens.fy * y, cx, cy };
}

// Width and height of which the longer is at most `longest`.
export function sizeWithin(W, H, longest) {
  const factor = Math.max(1, Math.max(W, H) / longest);
  return [W, H].map((side) => Math.max(1, Math.round(side / factor)));
}

// Whether a photo of a size has the aspect ratio of its camera, up to rounding by a pixel of the smaller one.
export const fits = (lens, W, H) =>
  Math.abs(H - (lens.H * W) / lens.W) <= Math.max(1, W / lens.W) * (1 + lens.H / lens.W);

// The pinhole camera with the largest field of view that shows nothing outside the photo, with as many pixels.
export function pinholeOf(lens) {
  const { W, H, fx, fy, cx, cy } = lens;
  if (!distorts(lens)) return { W, H, fx, fy, cx, cy };
  const [left, right, top, bottom] = insideOf(lens);
  if (!(left < right && top < bottom)) throw impossible(lens);
  const [across, down] = [(W - 1) / (right - left), (H - 1) / (bottom - top)];
  const ratio = Math.max(across / fx, down / fy); // the shape of pixels stays, so only a part of the rectangle is shown
  const [mx, my] = [(W - 1) / 2, (H - 1) / 2];
  const K = { fx: ratio * fx, fy: ratio * fy };
  const middle = [mx + across * left, my + down * top]; // the rectangle's middle, seen from its principal point
  const pinhole = { W, H, ...K, cx: mx - (middle[0] * K.fx) / across, cy: my - (middle[1] * K.fy) / down };
  const reach = Math.max(
    pinhole.cx / K.fx,
    (W - 1 - pinhole.cx) / K.fx,
    pinhole.cy / K.fy,
    (H - 1 - pinhole.cy) / K.fy,
  );
  const plausible = 1 / FOCAL_RANGE < ratio && ratio < FOCAL_RANGE && reach < STEEPEST;
  if (!plausible || isFolded(lens, pinhole)) throw impossible(lens);
  return pinhole;
}

// The largest rectangle of directions that a photo covers: left, right, top, bottom.
function insideOf(lens) {
  const along = Array.from({ length: RIM }, (_, i) => i / (RIM - 1));
  const [w, h] = [lens.W - 1, lens.H - 1];
  const xs = (u) => along.map((t) => rayOf(lens, u, t * h)[0]);
  const ys = (v) => along.map((t) => rayOf(lens, t * w, v)[1]);
  return [Math.max(...xs(0)), Math.min(...xs(w)), Math.max(...ys(0)), Math.min(...ys(h))];
}

// Whether the lens turns back within the pinhole's image, which would show a part of the photo twice.
function isFolded(lens, pinhole) {
  for (let i = 0; i < FOLD_GRID; ++i) {
    for (let j = 0; j < FOLD_GRID; ++j) {
      const x = ((i / (FOLD_GRID - 1)) * (pinhole.W - 1) - pinhole.cx) / pinhole.fx;
      const y = ((j / (FOLD_GRID - 1)) * (pinhole.H - 1) - pinhole.cy) / pinhole.fy;
      const [ax, ay, bx, by] = slopes(lens.coefficients, x, y);
      if (!(ax * by - ay * bx > 0)) return true;
    }
  }
  return false;
}

const impossible = (lens) =>
  new CaptureError(
    `The distortion of a lens (${lens.coefficients.map((c) => +c.toPrecision(3)).join(", ")}) cannot be removed here: ` +
      `check its calibration, or run "colmap image_undistorter" and drop the result.`,
  );

// A photo as a pinhole camera sees it, with sides of at most `longest` px: {pinhole, pixels: H W 3 bytes}. stored: the
// photo's H W 4 bytes; lens: of its size. Raises CaptureError.
export function asPinhole(stored, lens, longest) {
  const [whole, size] = [[lens.W, lens.H], sizeWithin(lens.W, lens.H, longest)];
  if (!distorts(lens)) return { pinhole: pinholeOf(resized(lens, ...size)), pixels: reduced(stored, whole, 4, size) };
  const middle = sizeWithin(lens.W, lens.H, 2 * longest); // twice as large, so that interpolation blurs less
  const small = resized(lens, ...middle);
  const pinhole = pinholeOf(small);
  const straight = undistorted(reduced(stored, whole, 4, middle), small, pinhole);
  return { pinhole: resized(pinhole, ...size), pixels: reduced(straight, middle, 3, size) };
}

// Averages an image over the pixels of a smaller one. pixels: H W `channels` bytes; returns h w 3 bytes.
export function reduced(pixels, [W, H], channels, [w, h]) {
  const across = sharesOf(W, w);
  const down = sharesOf(H, h);
  const row = new Float64Array(3 * W);
  const out = new Uint8Array(w * h * 3);
  for (let y = 0; y < h; ++y) {
    row.fill(0);
    for (let k = down.starts[y]; k < down.starts[y + 1]; ++k) {
      const [from, share] = [down.places[k] * W, down.shares[k]];
      for (let x = 0; x < W; ++x) {
        for (let c = 0; c < 3; ++c) row[3 * x + c] += share * pixels[(from + x) * channels + c];
      }
    }
    for (let x = 0; x < w; ++x) {
      let [red, green, blue] = [0, 0, 0];
      for (let k = across.starts[x]; k < across.starts[x + 1]; ++k) {
        const [at, share] = [3 * across.places[k], across.shares[k]];
        red += share * row[at];
        green += share * row[at + 1];
        blue += share * row[at + 2];
      }
      out.set([Math.round(red), Math.round(green), Math.round(blue)], 3 * (y * w + x));
    }
  }
  return out;
}

// What each of n pixels along a side covers of the N original ones: pixel i has the `places` and their `shares` from starts[i]
// to starts[i + 1].
function sharesOf(N, n) {
  const step = N / n;
  const [starts, places, shares] = [[0], [], []];
  for (let i = 0; i < n; ++i) {
    const [from, to] = [i * step, Math.min(N, (i + 1) * step)];
    for (let k = Math.floor(from); k < to; ++k) {
      const share = (Math.min(to, k + 1) - Math.max(from, k)) / step;
      if (share <= 0) continue;
      places.push(k);
      shares.push(share);
    }
    starts.push(places.length);
  }
  return { starts, places, shares };
}

// Where the pixels of a pinhole's image lie in the photo of a lens: columns and rows, px, within the photo.
function placesOf(lens, { W, H, fx, fy, cx, cy }) {
  const [us, vs] = [new Float32Array(W * H), new Float32Array(W * H)];
  for (let i = 0; i < W * H; ++i) {
    const [a, b] = distorted(lens.coefficients, ((i % W) - cx) / fx, (Math.floor(i / W) - cy) / fy);
    us[i] = Math.min(lens.W - 1, Math.max(0, lens.fx * a + lens.cx));
    vs[i] = Math.min(lens.H - 1, Math.max(0, lens.fy * b + lens.cy));
  }
  return [us, vs];
}

let known = { key: "", places: null }; // of the last lens: most captures have one

// A photo as its pinhole sees it, by bilinear interpolation. pixels: H W 3 bytes of the lens's size.
function undistorted(pixels, lens, pinhole) {
  const key = JSON.stringify([lens, pinhole]);
  if (known.key !== key) known = { key, places: placesOf(lens, pinhole) };
  const [us, vs] = known.places;
  const out = new Uint8Array(3 * us.length);
  for (let i = 0; i < us.length; ++i) {
    const [left, top] = [Math.floor(us[i]), Math.floor(vs[i])];
    const [s, t] = [us[i] - left, vs[i] - top];
    const at = 3 * (top * lens.W + left);
    const [right, down] = [left + 1 < lens.W ? 3 : 0, top + 1 < lens.H ? 3 * lens.W : 0];
    for (let c = 0; c < 3; ++c) {
      const upper = (1 - s) * pixels[at + c] + s * pixels[at + right + c];
      const lower = (1 - s) * pixels[at + down + c] + s * pixels[at + down + right + c];
      out[3 * i + c] = Math.round((1 - t) * upper + t * lower);
    }
  }
  return out;
}

// Fetches files of a streamed SOG and decodes runs of their splats, in its own thread.
//
// A 2D canvas would multiply colours by alpha, so pixels are read through WebGL, which returns them exactly. Decoded
// files are kept for a while because the runs of a file are wanted one after another.
"use strict";

const KEPT = 4; // files whose pixels are kept
const COEFFICIENTS = [0, 3, 8, 15]; // above degree 0, by degree
const PER_ROW = 64; // palette entries per row of its image
const STEPS = 65535; // of a coordinate
const FIRST_TAG = 252; // alpha of a rotation in which w is the largest component
const QUAT_STEPS = 32767;
const OPACITY_EDGE = 0.25 / 255;

let gl = null;
const kept = new Map(); // by address, the oldest first

self.onmessage = async ({ data }) => {
  try {
    const file = await opened(data.address);
    const parts = data.runs.map(({ offset, count }) => decoded(file, offset, count, data.degree));
    const buffers = parts.flatMap((part) => Object.values(part).map((array) => array.buffer));
    self.postMessage({ parts }, buffers);
  } catch (error) {
    self.postMessage({ failed: error?.message || String(error) });
  }
};

async function opened(address) {
  const found = kept.get(address) ?? (await loaded(address));
  kept.delete(address);
  kept.set(address, found);
  if (kept.size > KEPT) kept.delete(kept.keys().next().value);
  return found;
}

async function fetched(address) {
  const answer = await fetch(address, { cache: "no-store", credentials: "omit", redirect: "error" });
  if (!answer.ok) throw new Error(`${new URL(address).pathname} could not be loaded (${answer.status}).`);
  return answer;
}

async function loaded(address) {
  const meta = await (await fetched(address)).json();
  const image = async (name) => pixels(await (await fetched(new URL(name, address).href)).blob());
  const [low, high, quats, scales, sh0] = await Promise.all(
    [...meta.means.files, meta.quats.files[0], meta.scales.files[0], meta.sh0.files[0]].map(image),
  );
  const file = { meta, low, high, quats, scales, sh0, palette: null, labels: null };
  file.logScales = Float32Array.from(filled(meta.scales.codebook));
  file.colors = halves(filled(meta.sh0.codebook));
  if (meta.shN) {
    [file.palette, file.labels] = await Promise.all(meta.shN.files.map(image));
    file.harmonics = halves(filled(meta.shN.codebook));
  }
  return file;
}

// A codebook may start with null, which is extrapolated downwards.
function filled(codebook) {
  if (codebook[0] !== null) return codebook;
  return [codebook[1] - (codebook.at(-1) - codebook[1]) / (codebook.length - 1), ...codebook.slice(1)];
}

// The RGBA bytes of an image, first row first.
async function pixels(blob) {
  const bitmap = await createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  const { width, height } = bitmap;
  gl ??= new OffscreenCanvas(1, 1).getContext("webgl2");
  if (!gl) throw new Error("This browser cannot decode the scene: its workers lack WebGL2.");
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
  bitmap.close();
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  const bytes = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  gl.deleteFramebuffer(framebuffer);
  gl.deleteTexture(texture);
  if (gl.getError() !== gl.NO_ERROR) throw new Error("An image of the scene does not fit into this graphics processor.");
  return bytes;
}

// A run of splats in the layout of the page's textures.
function decoded(file, offset, count, degree) {
  const { meta } = file;
  const coefficients = 1 + COEFFICIENTS[degree];
  const run = {
    means: new Float32Array(3 * count),
    log_scales: new Float32Array(3 * count),
    quats: new Int16Array(4 * count),
    sh: new Uint16Array(3 * coefficients * count),
    logit_opacities: new Uint16Array(count),
  };
  const stored = meta.shN ? Math.min(COEFFICIENTS[meta.shN.bands], COEFFICIENTS[degree]) : 0;
  for (let i = 0; i < count; ++i) {
    const from = 4 * (offset + i);
    for (let axis = 0; axis < 3; ++axis) {
      const step = file.low[from + axis] | (file.high[from + axis] << 8);
      const [low, high] = [meta.means.mins[axis], meta.means.maxs[axis]];
      const log = low + ((high - low) * step) / STEPS;
      run.means[3 * i + axis] = Math.sign(log) * Math.expm1(Math.abs(log));
      run.log_scales[3 * i + axis] = file.logScales[file.scales[from + axis]];
      run.sh[3 * coefficients * i + axis] = file.colors[file.sh0[from + axis]];
    }
    rotation(file.quats, from, run.quats, 4 * i);
    run.logit_opacities[i] = LOGITS[file.sh0[from + 3]];
    if (stored) harmonics(file, from, run.sh, 3 * (coefficients * i + 1), stored);
  }
  return run;
}

// The omitted component is the largest of (w, x, y, z) and positive.
function rotation(bytes, from, quats, to) {
  const largest = bytes[from + 3] - FIRST_TAG;
  let rest = 1;
  for (let component = 0, k = 0; component < 4; ++component) {
    if (component === largest) continue;
    const small = (bytes[from + k++] / 255 - 0.5) * Math.SQRT2;
    rest -= small * small;
    quats[to + component] = Math.round(QUAT_STEPS * small);
  }
  quats[to + largest] = Math.round(QUAT_STEPS * Math.sqrt(Math.max(0, rest)));
}

function harmonics(file, from, sh, to, stored) {
  const label = file.labels[from] | (file.labels[from + 1] << 8);
  const wide = COEFFICIENTS[file.meta.shN.bands];
  const entry = 4 * (Math.floor(label / PER_ROW) * PER_ROW * wide + (label % PER_ROW) * wide);
  for (let k = 0; k < stored; ++k) {
    for (let channel = 0; channel < 3; ++channel) {
      sh[to + 3 * k + channel] = file.harmonics[file.palette[entry + 4 * k + channel]];
    }
  }
}

// Bits of the nearest float16 of each value, ties to even; beyond its range, the largest one.
function halves(values) {
  return Uint16Array.from(values, (value) => {
    const sign = value < 0 ? 0x8000 : 0;
    const size = Math.min(Math.abs(value), 65504);
    if (size < 2 ** -14) return sign | even(size * 2 ** 24);
    let exponent = Math.floor(Math.log2(size));
    if (2 ** exponent > size) --exponent;
    if (2 ** (exponent + 1) <= size) ++exponent;
    return sign | (((exponent + 15) << 10) + even((size / 2 ** exponent - 1) * 1024));
  });
}

function even(value) {
  const low = Math.floor(value);
  const rest = value - low;
  return low + (rest > 0.5 || (rest === 0.5 && low % 2 === 1) ? 1 : 0);
}

const LOGITS = halves(
  Array.from({ length: 256 }, (_, byte) => {
    const opacity = Math.min(1 - OPACITY_EDGE, Math.max(OPACITY_EDGE, byte / 255));
    return Math.log(opacity / (1 - opacity));
  }),
);

// Decodes runs of splats from the images of a streamed SOG.

const COEFFICIENTS = [0, 3, 8, 15]; // above degree 0, by degree
const PER_ROW = 64; // palette entries per row of its image
const STEPS = 65535; // of a coordinate
const FIRST_TAG = 252; // alpha of a rotation in which w is the largest component
const QUAT_STEPS = 32767;
const OPACITY_EDGE = 0.25 / 255;

// A codebook may start with null, which is extrapolated downwards.
export function filledCodebook(codebook) {
  if (codebook[0] !== null) return codebook;
  return [codebook[1] - (codebook.at(-1) - codebook[1]) / (codebook.length - 1), ...codebook.slice(1)];
}

// A run of splats in the layout of the page's textures.
export function decodedRun(file, offset, count, degree) {
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
export function halves(values) {
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

// The order of splats by camera depth of the mean, or by its distance, far to near.
//
// Positive float32 values sort like their bits, so two counting sorts of 16 bits each, low half first, give the exact
// order. Among equal depths the last index comes first: drawn far to near, this matches the renderer's near-to-far
// order. NaN counts as behind the camera.

const OFFSET = 256; // makes all values positive, so that their bits sort as they do

export class SortedSplats {
  // Takes the arrays of the splats, which it keeps. Scales and logits may be null if no sample is asked for.
  constructor([means, scales, logits], near) {
    Object.assign(this, { means, scales, logits, near });
    this.keys = new Uint32Array(means.length / 3);
    this.byLow = new Uint32Array(means.length / 3);
    this.ranked = this.values = null; // all splats by rank, and the value that ranks each
    this.kept = new Uint32Array(0); // what every sample contains
  }

  // Replaces means, beginning with splat `at`.
  replace(means, at) {
    this.means.set(means, 3 * at);
  }

  // Puts these splats into every sample, whatever their rank.
  keep(indices) {
    this.kept = indices;
  }

  // Fills the first `count` entries of `order` with the splats in front of the camera: of all, or of a sample of `most`,
  // whose thinning is not 0. Without an axis, they are sorted by distance, in all directions.
  sort(axis, eye, order, most) {
    const thins = most < this.keys.length;
    if (thins && !this.ranked) this.rank();
    const count = this.byDepth(axis, eye, order, thins ? this.sample(most) : null);
    return { count, thinning: thins ? Math.exp(OFFSET - this.values[this.ranked[most - 1]]) : 0 };
  }

  // The first splats by rank and those that every sample contains, in rising order.
  sample(most) {
    const first = this.ranked.subarray(0, most);
    if (!this.kept.length) return first.slice().sort();
    const all = new Uint32Array(first.length + this.kept.length);
    all.set(first);
    all.set(this.kept, first.length);
    return all.sort().filter((index, i) => index !== all[i - 1]);
  }

  // Fills the first entries of `order` and returns the number of splats in front of the camera, of all or of some, whose
  // indices rise.
  byDepth(axis, eye, order, some) {
    const { keys, means, near } = this;
    const depths = new Float32Array(keys.buffer);
    const [ax, ay, az] = axis ?? [];
    const [ex, ey, ez] = eye;
    const total = some ? some.length : keys.length;
    for (let j = 0; j < total; ++j) {
      const k = 3 * (some ? some[j] : j);
      const [x, y, z] = [means[k] - ex, means[k + 1] - ey, means[k + 2] - ez];
      const depth = axis ? ax * x + ay * y + az * z : Math.sqrt(x * x + y * y + z * z);
      depths[j] = depth > near ? depth : 0;
    }
    return this.byKeys(total, order, some);
  }

  // Writes the places of the keys that are not 0, or what `some` has at these places, to `order`, largest key first.
  byKeys(total, order, some) {
    const { keys, byLow } = this;
    const low = new Uint32Array(65536);
    const high = new Uint32Array(65536);
    let count = 0;
    for (let j = 0; j < total; ++j) {
      if (keys[j] === 0) continue;
      ++low[keys[j] & 65535];
      ++high[keys[j] >>> 16];
      ++count;
    }
    startsOf(low);
    startsOf(high);
    for (let j = 0; j < total; ++j) if (keys[j] !== 0) byLow[low[keys[j] & 65535]++] = j;
    for (let j = 0; j < count; ++j) {
      const place = byLow[j];
      order[count - 1 - high[keys[place] >>> 16]++] = some ? some[place] : place;
    }
    return count;
  }

  // Ranks the splats such that the first n are a random sample, in which splats of large opacity and area are likelier:
  // with u uniform in (0, 1) and the weight w = sqrt(opacity area), the largest values log(w / u) come first. With v the
  // last value that is taken, a splat is taken with probability min(1, w / exp(v)): exp(-v) is the sample's thinning, by
  // which the shader enlarges what is drawn.
  rank() {
    const { keys, scales, logits } = this;
    const values = new Float32Array(keys.length);
    for (let i = 0; i < keys.length; ++i) {
      const [a, b, c] = [scales[3 * i], scales[3 * i + 1], scales[3 * i + 2]];
      const weight = 0.5 * (a + b + c - Math.min(a, b, c) - Math.log1p(Math.exp(-half(logits[i]))));
      values[i] = OFFSET + Math.max(weight - Math.log(random(i)), 1 - OFFSET);
    }
    keys.set(new Uint32Array(values.buffer));
    this.values = values;
    this.ranked = new Uint32Array(keys.length);
    this.byKeys(keys.length, this.ranked, null);
  }
}

// A number in (0, 1) that looks random, the same for an index at any time.
function random(index) {
  let bits = Math.imul(index ^ (index >>> 16), 0x45d9f3b);
  bits = Math.imul(bits ^ (bits >>> 16), 0x45d9f3b);
  return (((bits ^ (bits >>> 16)) >>> 0) + 0.5) / 2 ** 32;
}

// The value of a float16.
function half(bits) {
  const [exponent, fraction] = [(bits >> 10) & 31, bits & 1023];
  const size = exponent ? 2 ** (exponent - 25) * (1024 + fraction) : 2 ** -24 * fraction;
  return bits & 0x8000 ? -size : size;
}

// Turns counts into the start of each bucket.
function startsOf(counts) {
  let sum = 0;
  for (let b = 0; b < counts.length; ++b) {
    const here = counts[b];
    counts[b] = sum;
    sum += here;
  }
}

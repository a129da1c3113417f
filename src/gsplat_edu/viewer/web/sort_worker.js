// Sorts splats by camera depth of the mean, far to near, in its own thread.
//
// Positive float32 values sort like their bits, so two counting sorts of 16 bits each, low half first, give the exact
// order. Among equal depths the last index comes first: drawn far to near, this matches the renderer's near-to-far
// order. NaN counts as behind the camera.
"use strict";

let means, near, keys, byLow;

self.onmessage = ({ data }) => {
  if (data.means) {
    ({ means, near } = data);
    keys = new Uint32Array(means.length / 3);
    byLow = new Uint32Array(means.length / 3);
    return;
  }
  if (data.replaced) {
    means.set(data.replaced, 3 * data.at);
    return;
  }
  const order = new Uint32Array(data.order);
  const count = sort(data.axis, data.eye, order);
  self.postMessage({ order: order.buffer, count }, [order.buffer]);
};

// Fills the first entries of `order` and returns the number of splats in front of the camera.
function sort(axis, eye, order) {
  const low = new Uint32Array(65536);
  const high = new Uint32Array(65536);
  const depths = new Float32Array(keys.buffer);
  const [ax, ay, az] = axis;
  const [ex, ey, ez] = eye;
  let count = 0;
  for (let i = 0, k = 0; i < keys.length; ++i, k += 3) {
    const depth = ax * (means[k] - ex) + ay * (means[k + 1] - ey) + az * (means[k + 2] - ez);
    depths[i] = depth > near ? depth : 0;
    if (depths[i] === 0) continue;
    ++low[keys[i] & 65535];
    ++high[keys[i] >>> 16];
    ++count;
  }
  startsOf(low);
  startsOf(high);
  for (let i = 0; i < keys.length; ++i) if (keys[i] !== 0) byLow[low[keys[i] & 65535]++] = i;
  for (let j = 0; j < count; ++j) order[count - 1 - high[keys[byLow[j]] >>> 16]++] = byLow[j];
  return count;
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

import assert from "node:assert/strict";
import { test } from "node:test";
import { gzipSync } from "node:zlib";

import { arraysIn, inflated } from "../../src/gsplat_edu/viewer/web/scene.js";
import { decodedRun, filledCodebook, halves } from "../../src/gsplat_edu/viewer/web/sog_runs.js";
import { SortedSplats } from "../../src/gsplat_edu/viewer/web/sorted_splats.js";
import { arrayOf, assertClose, vectors } from "./vectors.js";

const NEAR = 0.05;

test("splats are sorted by float32 depth, equal ones from the last to the first", () => {
  const { means, order } = vectors("order");
  const splats = new SortedSplats([arrayOf(means), null, null], NEAR);
  const found = new Uint32Array(arrayOf(means).length / 3);
  const { count, thinning } = splats.sort([0, 0, 1], [0, 0, -0.5], found, Infinity);
  assert.deepEqual(found.subarray(0, count), arrayOf(order));
  assert.equal(thinning, 0);
});

test("splats that are replaced by NaN are not drawn", () => {
  const splats = new SortedSplats([Float32Array.of(0, 0, 1, 0, 0, 3, 0, 0, 2), null, null], NEAR);
  const order = new Uint32Array(3);
  splats.replace(Float32Array.of(NaN, NaN, NaN), 1);
  assert.equal(splats.sort([0, 0, 1], [0, 0, 0], order, Infinity).count, 2);
  assert.deepEqual([...order.subarray(0, 2)], [2, 0]);
});

test("a sample is the same each time and covers as much", () => {
  const data = vectors("sample");
  const [means, scales, logits, area, weight] = [data.means, data.log_scales, data.logits, data.area, data.weight].map(
    arrayOf,
  );
  const splats = new SortedSplats([means, scales, logits], NEAR);
  const sorted = (most) => {
    const order = new Uint32Array(area.length);
    const { count, thinning } = splats.sort([0, 0, 1], [0, 0, -3], order, most);
    return { chosen: order.slice(0, count), thinning };
  };
  const { chosen, thinning } = sorted(2000);
  assert.equal(sorted(Infinity).chosen.length, area.length);
  assert.deepEqual(sorted(2000), { chosen, thinning });
  assert.equal(new Set(chosen).size, 2000);
  const chance = weight.map((one) => Math.min(1, thinning * one));
  const sum = (list) => list.reduce((total, value) => total + value, 0);
  // the number of sampled splats is within 4 sqrt(2000) = 180 of its mean of 2000
  assertClose(sum(chance), 2000, { absolute: 180 });
  // the estimate of the total is unbiased, with variance the sum of area² (1 / chance - 1)
  const spread = Math.sqrt(sum(area.map((one, i) => one ** 2 * (1 / chance[i] - 1))));
  const estimate = [...chosen].reduce((total, i) => total + area[i] / chance[i], 0);
  assertClose(estimate, sum(area), { absolute: 4 * spread });
  assert.ok(spread < 0.1 * sum(area), "a sharp picture follows");
});

test("a sample contains what it is to keep, each once and in order of depth", () => {
  const data = vectors("sample");
  const [means, scales, logits] = [data.means, data.log_scales, data.logits].map(arrayOf);
  const splats = new SortedSplats([means, scales, logits], NEAR);
  const sorted = () => {
    const order = new Uint32Array(means.length / 3);
    const { count, thinning } = splats.sort([0, 0, 1], [0, 0, -3], order, 2000);
    return { chosen: [...order.slice(0, count)], thinning };
  };
  const before = sorted();
  const left = Array.from({ length: means.length / 3 }, (_, i) => i).find((i) => !before.chosen.includes(i));
  splats.keep(Uint32Array.of(before.chosen[5], left).sort());
  const after = sorted();
  assert.equal(after.thinning, before.thinning);
  assert.deepEqual(
    after.chosen.filter((i) => i !== left),
    before.chosen,
  );
  assert.equal(after.chosen.length, before.chosen.length + 1);
  const depths = after.chosen.map((i) => Math.fround(means[3 * i + 2] + 3));
  assert.ok(depths.every((depth, i) => i === 0 || depth <= depths[i - 1]));
  splats.keep(new Uint32Array(0));
  assert.deepEqual(sorted(), before);
});

test("packed splats are unpacked as Python packs them", async () => {
  const { facts, packed, ...expected } = vectors("packed-scene");
  const data = gzipSync(Buffer.from(packed, "base64"));
  const halves = [data.subarray(0, 99), data.subarray(99)];
  const elements = halves.map((part) => ({ textContent: part.toString("base64"), remove() {} }));
  const bytes = await inflated(elements, Buffer.from(packed, "base64").length);
  const arrays = arraysIn(bytes.buffer, 0, facts);
  assert.deepEqual(Object.keys(arrays).sort(), Object.keys(expected).sort());
  for (const [name, array] of Object.entries(arrays)) assert.deepEqual(array, arrayOf(expected[name]), name);
});

test("damaged splats are reported", async () => {
  const data = gzipSync(Buffer.alloc(100)).subarray(0, 15);
  const elements = [{ textContent: data.toString("base64"), remove() {} }];
  await assert.rejects(inflated(elements, 100), /damaged; download or export the file again/);
});

// Means are computed in double here and rounded once; Python computes them in float32, with a relative error of a few
// 2^-24. Quaternions are rounded to steps, and float32 is far finer than one of them.
test("a run of a streamed scene has the values that Python reads", () => {
  const expected = vectors("streamed-run");
  const { meta } = expected;
  const image = (name) => arrayOf(expected.images[name]);
  const [low, high] = meta.means.files.map(image);
  const [palette, labels] = meta.shN.files.map(image);
  const file = {
    meta,
    low,
    high,
    palette,
    labels,
    quats: image(meta.quats.files[0]),
    scales: image(meta.scales.files[0]),
    sh0: image(meta.sh0.files[0]),
    logScales: Float32Array.from(filledCodebook(meta.scales.codebook)),
    colors: halves(filledCodebook(meta.sh0.codebook)),
    harmonics: halves(filledCodebook(meta.shN.codebook)),
  };
  const [offset, count] = [100, 150];
  const rows = (values, width) => values.slice(width * offset, width * (offset + count));
  const run = decodedRun(file, offset, count, 2);
  assertClose(Array.from(run.means), rows(expected.means, 1), { absolute: 1e-6, relative: 1e-6 }, "means");
  assert.deepEqual(run.log_scales, rows(arrayOf(expected.log_scales), 3));
  assertClose(Array.from(run.quats), rows(expected.quats, 1), { absolute: 0.51 }, "quaternions");
  assert.deepEqual(run.sh, rows(arrayOf(expected.sh), 27));
  assert.deepEqual(run.logit_opacities, halves(rows(expected.logit_opacities, 1)));
  const flat = decodedRun(file, offset, count, 0);
  const colors = Uint16Array.from({ length: 3 * count }, (_, i) => run.sh[27 * Math.floor(i / 3) + (i % 3)]);
  assert.deepEqual(flat.sh, colors, "a page of degree 0 takes the first coefficient");
});

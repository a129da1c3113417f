// Reads what tests/js/vectors.py computed, and compares with it.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { env } from "node:process";

const TYPES = {
  float32: Float32Array,
  float64: Float64Array,
  int16: Int16Array,
  uint8: Uint8Array,
  uint16: Uint16Array,
  uint32: Uint32Array,
};

export function vectors(name) {
  return JSON.parse(readFileSync(join(env.GSPLAT_EDU_VECTORS, `${name}.json`), "utf8"));
}

// The numbers of an array, to the bit.
export function arrayOf({ dtype, base64 }) {
  const bytes = Uint8Array.from(Buffer.from(base64, "base64"));
  return new TYPES[dtype](bytes.buffer);
}

// Whether numbers, or nested lists of them, differ by at most `absolute` plus `relative` times the expected ones.
export function assertClose(found, expected, { absolute = 0, relative = 0 }, message = "") {
  const [a, b] = [found, expected].map((numbers) => [numbers].flat(Infinity));
  assert.equal(a.length, b.length, message);
  for (const [i, value] of a.entries()) {
    const apart = Math.abs(value - b[i]);
    assert.ok(apart <= absolute + relative * Math.abs(b[i]), `${message}: ${value} instead of ${b[i]} at ${i}`);
  }
}

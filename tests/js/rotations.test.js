import assert from "node:assert/strict";
import { test } from "node:test";

import { eigenvectors, upOfCameras } from "../../src/gsplat_edu/viewer/web/edit_level.js";
import {
  anglesOfRows,
  degrees,
  product3,
  rowsOfAngles,
  turnedRows,
} from "../../src/gsplat_edu/viewer/web/edit_rotations.js";
import { transposed } from "../../src/gsplat_edu/viewer/web/vectors.js";
import { assertClose, vectors } from "./vectors.js";

const IDENTITY = [
  [1, 0, 0],
  [0, 1, 0],
  [0, 0, 1],
];
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const upOf = (rotations) => upOfCameras(rotations.map((R) => ({ R })));

test("angles are tilt, heading and roll", () => {
  const { angles, rows } = vectors("rotations");
  for (const [i, three] of angles.entries()) {
    assertClose(rowsOfAngles(three), rows[i], { absolute: 1e-14 });
    assertClose(anglesOfRows(rowsOfAngles(three)), three, { absolute: 1e-12 });
  }
  const upwards = rowsOfAngles([Math.PI / 2, 0.4, 0.3]); // roll and heading turn about one axis
  assert.equal(anglesOfRows(upwards)[2], 0);
  assertClose(rowsOfAngles(anglesOfRows(upwards)), upwards, { absolute: 1e-7 });
});

test("ten thousand turns leave a rotation", () => {
  let rows = rowsOfAngles([0.1, 0.2, 0.3]);
  for (let i = 0; i < 10000; ++i) rows = turnedRows(rows, transposed(rows)[i % 3], 0.1 + i);
  assertClose(product3(rows, transposed(rows)), IDENTITY, { absolute: 1e-15 });
  const [a, b, c] = rows;
  const cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  assertClose(dot(cross, c), 1, { absolute: 1e-6 }); // not a mirror image
});

test("eigenvalues are those of NumPy", () => {
  for (const { matrix, values } of vectors("eigenvalues")) {
    const pairs = eigenvectors(matrix);
    assertClose(
      pairs.map(({ value }) => value),
      values,
      { absolute: 1e-12 },
    );
    for (const { value, vector } of pairs) {
      const image = matrix.map((row) => dot(row, vector));
      assertClose(
        image,
        vector.map((x) => value * x),
        { absolute: 1e-12 },
      );
      assertClose(dot(vector, vector), 1, { absolute: 1e-6 });
    }
  }
});

test("level cameras give the exact tilt", () => {
  const { up, level } = vectors("tilts");
  for (const rotations of level) {
    const found = upOf(rotations);
    assertClose(found.up, up, { absolute: 1e-7 });
    assert.equal(found.count, rotations.length);
  }
});

// In an arc the error lies along one direction, so its root mean square is the standard error; all around, both
// horizontal directions have that error.
test("the error of rolled photos is as large as stated", () => {
  const { up, rolled } = vectors("tilts");
  for (const { directions, photos } of rolled) {
    const found = photos.map(upOf);
    const squares = found.map((one) => degrees(Math.acos(Math.min(1, dot(one.up, up)))) ** 2);
    const mean = (list) => list.reduce((sum, value) => sum + value, 0) / list.length;
    const ratio = Math.sqrt(mean(squares) / directions) / mean(found.map(({ error }) => degrees(error)));
    assert.ok(ratio > 0.7 && ratio < 1.4, `${ratio}`);
  }
});

test("a few portrait photos do not matter, and cameras that leave the tilt open are refused", () => {
  const { up, few, differently, row, two } = vectors("tilts");
  assert.ok(degrees(Math.acos(dot(upOf(few).up, up))) < 3);
  for (const rotations of differently) assert.match(upOf(rotations).refused, /rolled too differently/);
  assert.match(upOf(row).refused, /nearly one direction/);
  assert.match(upOf(two).refused, /at least 3/);
});

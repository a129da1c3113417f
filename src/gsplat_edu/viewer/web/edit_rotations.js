// Rotations of the editor's shapes, by rows and by angles.

import { cross, dot, plus, transposed, turned, unit } from "./vectors.js";

const GIMBAL = 1 - 1e-12; // sine of the tilt beyond which heading and roll turn about the same axis

export const degrees = (angle) => (angle * 180) / Math.PI;
export const product3 = (a, b) =>
  a.map((row) => [0, 1, 2].map((j) => row[0] * b[0][j] + row[1] * b[1][j] + row[2] * b[2][j]));

// The rotation closest to one that rounding has bent: its columns made orthonormal, the first one first.
export function orthonormal(rows) {
  const [first, second] = transposed(rows);
  const x = unit(first);
  const y = unit(plus(second, x, -dot(x, second)));
  return transposed([x, y, cross(x, y)]);
}

// A rotation, given by its rows, after a further turn about an axis of length 1.
export function turnedRows(rows, axis, angle) {
  return orthonormal(transposed(transposed(rows).map((column) => turned(column, axis, angle))));
}

// The rotation by three angles in radians: about z, then x, then y. With y vertical they are roll, tilt and heading.
export function rowsOfAngles([tilt, heading, roll]) {
  const about = (axis, angle) =>
    transposed(
      [0, 1, 2].map((j) =>
        turned(
          [0, 1, 2].map((i) => Number(i === j)),
          axis,
          angle,
        ),
      ),
    );
  return orthonormal(product3(about([0, 1, 0], heading), product3(about([1, 0, 0], tilt), about([0, 0, 1], roll))));
}

// The angles [tilt, heading, roll] of a rotation; at a tilt of +-90 degrees, where heading and roll
// turn about the same axis, the roll is 0.
export function anglesOfRows(rows) {
  const sine = Math.min(Math.max(-rows[1][2], -1), 1);
  if (Math.abs(sine) > GIMBAL) return [Math.asin(sine), Math.atan2(-rows[2][0], rows[0][0]), 0];
  return [Math.asin(sine), Math.atan2(rows[0][2], rows[2][2]), Math.atan2(rows[1][0], rows[1][1])];
}

// Vectors of three numbers.

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const plus = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
export const transposed = (rows) => [0, 1, 2].map((i) => rows.map((row) => row[i]));
export const radians = (degrees) => (degrees * Math.PI) / 180;
export const unit = (a) => {
  const length = Math.hypot(...a);
  return a.map((value) => value / length);
};

// Rotates a vector about an axis of length 1 by the right-hand rule (Rodrigues' formula).
export function turned(vector, axis, angle) {
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  const around = cross(axis, vector);
  const along = dot(axis, vector) * (1 - cos);
  return vector.map((value, i) => value * cos + around[i] * sin + axis[i] * along);
}

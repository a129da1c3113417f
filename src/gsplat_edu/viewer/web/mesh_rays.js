// Where a ray meets a mesh, in float64 on the stored float32 coordinates.

// The smallest t above `near` at which origin + t direction lies in a face; Infinity if there is none. Faces are seen
// from both sides (Möller and Trumbore, 1997).
export function rayMeets({ positions, faces }, origin, direction, near = 0) {
  const [ox, oy, oz] = origin;
  const [dx, dy, dz] = direction;
  let nearest = Infinity;
  for (let i = 0; i < faces.length; i += 3) {
    const [a, b, c] = [3 * faces[i], 3 * faces[i + 1], 3 * faces[i + 2]];
    const [ax, ay, az] = [positions[a], positions[a + 1], positions[a + 2]];
    const [ex, ey, ez] = [positions[b] - ax, positions[b + 1] - ay, positions[b + 2] - az];
    const [fx, fy, fz] = [positions[c] - ax, positions[c + 1] - ay, positions[c + 2] - az];
    const [px, py, pz] = [dy * fz - dz * fy, dz * fx - dx * fz, dx * fy - dy * fx];
    const det = ex * px + ey * py + ez * pz;
    if (det === 0) continue; // the ray is parallel to the face, or the face has no area
    const [sx, sy, sz] = [ox - ax, oy - ay, oz - az];
    const u = (sx * px + sy * py + sz * pz) / det;
    if (!(u >= 0 && u <= 1)) continue;
    const [qx, qy, qz] = [sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex];
    const v = (dx * qx + dy * qy + dz * qz) / det;
    if (!(v >= 0 && u + v <= 1)) continue;
    const t = (fx * qx + fy * qy + fz * qz) / det;
    if (t > near && t < nearest) nearest = t;
  }
  return nearest;
}

// The edges of a mesh, each once: two vertices after each other.
export function edgesOf({ positions, faces }) {
  const count = positions.length / 3;
  const keys = new Float64Array(faces.length); // smaller vertex times count, plus the larger one
  for (let i = 0; i < faces.length; ++i) {
    const [a, b] = [faces[i], faces[i % 3 === 2 ? i - 2 : i + 1]];
    keys[i] = Math.min(a, b) * count + Math.max(a, b);
  }
  keys.sort();
  const edges = new Uint32Array(2 * keys.length);
  let filled = 0;
  for (let i = 0; i < keys.length; ++i) {
    if (i && keys[i] === keys[i - 1]) continue;
    edges[filled++] = Math.floor(keys[i] / count);
    edges[filled++] = keys[i] % count;
  }
  return edges.slice(0, filled);
}

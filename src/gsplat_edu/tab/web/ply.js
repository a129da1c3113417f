// Gaussians as the scene PLY that 3DGS viewers read; the twin of gsplat_edu/io/ply.py.

const BLOCK = 1 << 14;

// The parts of the file, for a Blob. gaussians: {count, means (N 3), quats (N 4), log_scales (N 3), sh0 (N 3),
// sh_rest (N K 3), logit_opacities (N)}, raw float32 values.
export function plyOf(gaussians) {
  const { count, means, quats, log_scales: scales, sh0, sh_rest: rest, logit_opacities: opacities } = gaussians;
  const K = count ? rest.length / (3 * count) : 0;
  const names = (stem, number) => Array.from({ length: number }, (_, i) => `${stem}_${i}`);
  const properties = [
    ...["x", "y", "z", "nx", "ny", "nz"],
    ...[...names("f_dc", 3), ...names("f_rest", 3 * K)],
    ...["opacity", ...names("scale", 3), ...names("rot", 4)],
  ];
  const header = ["ply", "format binary_little_endian 1.0", `element vertex ${count}`];
  const text = [...header, ...properties.map((name) => `property float ${name}`), "end_header", ""].join("\n");
  const parts = [new TextEncoder().encode(text)];
  for (let start = 0; start < count; start += BLOCK) {
    const end = Math.min(count, start + BLOCK);
    const view = new DataView(new ArrayBuffer(4 * properties.length * (end - start)));
    let at = 0;
    const put = (value) => {
      view.setFloat32(at, value, true);
      at += 4;
    };
    const row = (array, i, size) => {
      for (let c = 0; c < size; ++c) put(array[i * size + c]);
    };
    for (let i = start; i < end; ++i) {
      row(means, i, 3);
      at += 12; // normals, which are zero
      row(sh0, i, 3);
      for (let c = 0; c < 3; ++c) for (let k = 0; k < K; ++k) put(rest[(i * K + k) * 3 + c]);
      put(opacities[i]);
      row(scales, i, 3);
      row(quats, i, 4);
    }
    parts.push(new Uint8Array(view.buffer));
  }
  return parts;
}

// Reads and writes .ksplat with the code of GaussianSplats3D, which defines the format.
// node ksplat.mjs read FILE: prints the splats. node ksplat.mjs write PLY LEVEL DEGREE OUT: converts a PLY.
import { readFileSync, writeFileSync } from "node:fs";
import { PlyParser, SplatBuffer } from "@mkkellogg/gaussian-splats-3d";

const bufferOf = (path) => {
  const file = readFileSync(path);
  return file.buffer.slice(file.byteOffset, file.byteOffset + file.length);
};

const [what, path, level, degree, out] = process.argv.slice(2);
if (what === "read") {
  const splats = new SplatBuffer(bufferOf(path));
  const count = splats.getSplatCount();
  const degreeOfAll = splats.getMinSphericalHarmonicsDegree();
  const values = (width) => new Float32Array(width * count);
  const [centers, scales, rotations, sh] = [values(3), values(3), values(4), values([0, 9, 24][degreeOfAll])];
  const colors = new Uint8Array(4 * count);
  splats.fillSplatCenterArray(centers);
  splats.fillSplatScaleRotationArray(scales, rotations, undefined, 0, count - 1, 0, 0);
  splats.fillSplatColorArray(colors, 0);
  const isBytes = splats.compressionLevel === 2; // which its shader decodes
  if (degreeOfAll) splats.fillSphericalHarmonicsArray(sh, degreeOfAll, undefined, 0, count - 1, 0, isBytes ? 2 : 0);
  const { minSphericalHarmonicsCoeff: low, maxSphericalHarmonicsCoeff: high } = splats;
  if (isBytes) for (let i = 0; i < sh.length; i++) sh[i] = low + (sh[i] / 255) * (high - low);
  const lists = Object.entries({ centers, scales, rotations, colors, sh }).map(([name, all]) => [name, [...all]]);
  console.log(JSON.stringify(Object.fromEntries(lists)));
} else {
  const splats = PlyParser.parseToUncompressedSplatArray(bufferOf(path), Number(degree));
  const made = SplatBuffer.generateFromUncompressedSplatArrays([splats], 0, Number(level), { x: 0, y: 0, z: 0 });
  writeFileSync(out, Buffer.from(made.bufferData));
}

// Reads a file of splats with the loaders of three.js, and prints the geometry that they make of it.
// node three_splats.mjs FILE
import { readFileSync } from "node:fs";
import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { GaussianSplatPLYLoader } from "three/addons/loaders/GaussianSplatPLYLoader.js";
import { KSPLATLoader } from "three/addons/loaders/KSPLATLoader.js";
import { SPLATLoader } from "three/addons/loaders/SPLATLoader.js";
import { SPZLoader } from "three/addons/loaders/SPZLoader.js";

globalThis.self = globalThis; // GLTFLoader names it

const LOADERS = { ksplat: KSPLATLoader, ply: GaussianSplatPLYLoader, splat: SPLATLoader, spz: SPZLoader };

async function ofGlb(buffer) {
  const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const { scene } = await loader.parseAsync(buffer, "");
  let found;
  scene.updateMatrixWorld();
  scene.traverse((node) => {
    if (node.isGaussianSplat) found = node;
  });
  return { geometry: found.splatGeometry, matrix: found.matrixWorld.elements };
}

const file = readFileSync(process.argv[2]);
const buffer = file.buffer.slice(file.byteOffset, file.byteOffset + file.length);
const suffix = process.argv[2].split(".").at(-1);
const { geometry, matrix } =
  suffix === "glb" ? await ofGlb(buffer) : { geometry: await new LOADERS[suffix]().parse(buffer) };
const values = Object.entries(geometry.attributes).map(([name, attribute]) => [name, [...attribute.array]]);
console.log(JSON.stringify({ ...Object.fromEntries(values), ...(matrix && { matrix }) }));

// Prints what the validator finds in each file of the arguments, as JSON.
import { readFileSync } from "node:fs";
import validator from "gltf-validator";

const found = {};
for (const file of process.argv.slice(2)) {
  const { issues, info } = await validator.validateBytes(new Uint8Array(readFileSync(file)));
  found[file] = { ...issues, triangles: info?.totalTriangleCount ?? 0 };
}
console.log(JSON.stringify(found));

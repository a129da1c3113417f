// Prints what the page's reader makes of a folder or a zip file, as JSON. Arguments: the path, width and height of photos
// whose capture does not say them.

import { readdirSync, readFileSync, statSync } from "node:fs";
import { readCapture } from "../../src/gsplat_edu/tab/web/capture.js";
import { pinholeOf } from "../../src/gsplat_edu/tab/web/lens.js";
import { CaptureError } from "../../src/gsplat_edu/tab/web/reading.js";
import { lensFor } from "../../src/gsplat_edu/tab/web/transforms.js";
import { unzipped } from "../../src/gsplat_edu/tab/web/zip.js";

const [place, W, H] = process.argv.slice(2);

const blob = (path) => new Blob([readFileSync(path)]);

function filesIn(folder) {
  const files = readdirSync(folder, { recursive: true }).filter((name) => statSync(`${folder}/${name}`).isFile());
  return files.map((name) => ({ path: `dropped/${name}`, file: blob(`${folder}/${name}`) }));
}

async function said() {
  const files = statSync(place).isFile() ? await unzipped(blob(place)) : filesIn(place);
  const { layout, frames, cloud, notes } = await readCapture(files);
  const views = frames.map(({ file, lens, ...frame }) => {
    const its = lens ?? lensFor(frame, Number(W), Number(H));
    const { name, path, part, R, eye } = frame;
    return { name, path, part, R, eye, size: file.size, lens: its, pinhole: pinholeOf(its) };
  });
  const lists = cloud && { points: [...cloud.points], colors: [...cloud.colors] };
  return { layout, notes, views, cloud: lists };
}

try {
  console.log(JSON.stringify(await said()));
} catch (error) {
  if (!(error instanceof CaptureError)) throw error;
  console.log(JSON.stringify({ error: error.message }));
}

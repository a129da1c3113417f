// Photos of a capture, decoded by the browser at the size that the training needs; runs in a worker.

import { asPinhole, fits, resized } from "./lens.js";
import { CaptureError } from "./reading.js";
import { lensFor } from "./transforms.js";

const [APP1, SCAN] = [0xe1, 0xda]; // markers of a JPEG: EXIF data, and the compressed pixels

// The view of a frame: {name, part, camera: {R, eye, fx, fy, cx, cy, W, H}, pixels: H W 3 bytes}, as a pinhole sees it.
// longest: its longest side, px. Raises CaptureError.
export async function decodedView(frame, longest) {
  const { name, part, R, eye } = frame;
  const { stored, W, H, given } = await fitting(frame, await frame.file.arrayBuffer());
  const { pinhole, pixels } = asPinhole(stored, resized(given, W, H), longest);
  return { name, part, camera: { R, eye, ...pinhole }, pixels };
}

// Decodes a photo as it is stored, to which poses usually refer; else turned as its EXIF data say.
async function fitting(frame, buffer) {
  let wrong = "";
  for (const bytes of [withoutExif(buffer), buffer]) {
    const photo = await decoded(bytes, frame.name);
    const given = frame.lens ?? lensFor(frame, photo.W, photo.H);
    if (fits(given, photo.W, photo.H)) return { ...photo, given };
    wrong ||= `${frame.name} has ${photo.W} x ${photo.H} pixels, but its camera ${given.W} x ${given.H}`;
  }
  throw new CaptureError(`${wrong}: drop the photos with which the poses were found.`);
}

async function decoded(bytes, name) {
  const bitmap = await createImageBitmap(new Blob([bytes])).catch(() => {
    throw new CaptureError(`This browser cannot open the photo ${name}: convert it to JPEG or PNG.`);
  });
  const { width: W, height: H } = bitmap;
  const context = new OffscreenCanvas(W, H).getContext("2d", { willReadFrequently: true, colorSpace: "srgb" });
  context.fillRect(0, 0, W, H); // black behind transparent pixels
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return { stored: context.getImageData(0, 0, W, H).data, W, H };
}

// The bytes of a JPEG without its EXIF data, by which a browser would turn it; those of other files as they are.
// Source: ITU-T T.81, annex B.1.1.4.
export function withoutExif(buffer) {
  const view = new DataView(buffer);
  if (view.byteLength < 4 || view.getUint16(0) !== 0xffd8) return buffer;
  const parts = [buffer.slice(0, 2)];
  let at = 2;
  while (at + 4 <= view.byteLength && view.getUint8(at) === 0xff && view.getUint8(at + 1) !== SCAN) {
    const end = at + 2 + view.getUint16(at + 2);
    if (view.getUint8(at + 1) !== APP1) parts.push(buffer.slice(at, end));
    at = end;
  }
  return new Blob([...parts, buffer.slice(at)]);
}

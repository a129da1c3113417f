// Fetches files of a streamed SOG and decodes runs of their splats, in its own thread.
//
// A 2D canvas would multiply colours by alpha, so pixels are read through WebGL, which returns them exactly. Decoded
// files are kept for a while because the runs of a file are wanted one after another.

import { decodedRun, filledCodebook, halves } from "./sog_runs.js";

const KEPT = 4; // files whose pixels are kept

let gl = null;
const kept = new Map(); // by address, the oldest first

self.onmessage = async ({ data }) => {
  try {
    const file = await opened(data.address);
    const parts = data.runs.map(({ offset, count }) => decodedRun(file, offset, count, data.degree));
    const buffers = parts.flatMap((part) => Object.values(part).map((array) => array.buffer));
    self.postMessage({ parts }, buffers);
  } catch (error) {
    self.postMessage({ failed: error?.message || String(error) });
  }
};

async function opened(address) {
  const found = kept.get(address) ?? (await loaded(address));
  kept.delete(address);
  kept.set(address, found);
  if (kept.size > KEPT) kept.delete(kept.keys().next().value);
  return found;
}

async function fetched(address) {
  const answer = await fetch(address, { cache: "no-store", credentials: "omit", redirect: "error" });
  if (!answer.ok) throw new Error(`${new URL(address).pathname} could not be loaded (${answer.status}).`);
  return answer;
}

async function loaded(address) {
  const meta = await (await fetched(address)).json();
  const image = async (name) => pixels(await (await fetched(new URL(name, address).href)).blob());
  const [low, high, quats, scales, sh0] = await Promise.all(
    [...meta.means.files, meta.quats.files[0], meta.scales.files[0], meta.sh0.files[0]].map(image),
  );
  const file = { meta, low, high, quats, scales, sh0, palette: null, labels: null };
  file.logScales = Float32Array.from(filledCodebook(meta.scales.codebook));
  file.colors = halves(filledCodebook(meta.sh0.codebook));
  if (meta.shN) {
    [file.palette, file.labels] = await Promise.all(meta.shN.files.map(image));
    file.harmonics = halves(filledCodebook(meta.shN.codebook));
  }
  return file;
}

// The RGBA bytes of an image, first row first.
async function pixels(blob) {
  const bitmap = await createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  const { width, height } = bitmap;
  gl ??= new OffscreenCanvas(1, 1).getContext("webgl2");
  if (!gl) throw new Error("This browser cannot decode the scene: its workers lack WebGL2.");
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
  bitmap.close();
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  const bytes = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
  gl.deleteFramebuffer(framebuffer);
  gl.deleteTexture(texture);
  if (gl.getError() !== gl.NO_ERROR)
    throw new Error("An image of the scene does not fit into this graphics processor.");
  return bytes;
}

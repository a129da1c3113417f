// Unpacks the scene embedded in a page, in the format written by page.py.

// Arrays of the binary data in their order; `page_data.py` has the same list.
export function layout(facts) {
  const coefficients = (facts.sh_degree + 1) ** 2;
  return [
    { name: "means", type: Float32Array, channels: 3, texels: 1 },
    { name: "log_scales", type: Float32Array, channels: 3, texels: 1 },
    { name: "quats", type: Int16Array, channels: 4, texels: 1 },
    { name: "sh", type: Uint16Array, channels: 3, texels: coefficients }, // float16
    { name: "logit_opacities", type: Uint16Array, channels: 1, texels: 1 }, // float16
  ];
}

// Returns the splats as typed arrays by name. The text is removed from the page piece by piece, so that it and the
// numbers are never in memory together.
// `tell` hears how much is unpacked, from 0 to 1.
export async function unpackSplats(facts, tell) {
  const total = layout(facts).reduce((sum, part) => sum + lengthOf(part, facts) * part.type.BYTES_PER_ELEMENT, 0);
  const bytes = await inflated(document.querySelectorAll("script.splats"), total, tell);
  return arraysIn(bytes.buffer, 0, facts);
}

function lengthOf({ channels, texels }, facts) {
  return facts.count * channels * texels;
}

// The arrays of packed splats that begin at a byte of a buffer.
export function arraysIn(buffer, begin, facts) {
  const arrays = {};
  for (const part of layout(facts)) {
    arrays[part.name] = new part.type(buffer, begin, lengthOf(part, facts));
    begin += arrays[part.name].byteLength;
  }
  return arrays;
}

export async function inflated(elements, total, tell = () => {}) {
  if (typeof DecompressionStream === "undefined") {
    throw new Error("This browser cannot unpack the scene: it lacks DecompressionStream; use a newer version.");
  }
  if (!total) return new Uint8Array(0); // nothing is packed
  const waiting = [...elements];
  const packed = new ReadableStream({
    pull(controller) {
      const element = waiting.shift();
      if (!element) return controller.close();
      controller.enqueue(decoded(element.textContent));
      element.remove();
    },
  });
  const bytes = new Uint8Array(total);
  let filled = 0;
  try {
    const reader = packed.pipeThrough(new DecompressionStream("gzip")).getReader();
    for (let { done, value } = await reader.read(); !done; { done, value } = await reader.read()) {
      bytes.set(value, filled);
      filled += value.length;
      tell(filled / total);
    }
  } catch {
    filled = -1; // the details would not help the reader of the message
  }
  if (filled !== total) throw new Error("The scene in this file is damaged; download or export the file again.");
  return bytes;
}

function decoded(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; ++i) bytes[i] = text.charCodeAt(i);
  return bytes;
}

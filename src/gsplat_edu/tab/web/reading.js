// Numbers and text of files that may be damaged.

const LONGEST_NAME = 1 << 16; // bytes; no system has longer paths

// What is wrong with a capture: one sentence for the person who dropped it.
export class CaptureError extends Error {}

// Numbers of a binary file, one after another. path: the file, for messages.
export class Bytes {
  constructor(buffer, path, little = true) {
    Object.assign(this, { view: new DataView(buffer), path, little, at: 0 });
  }

  get left() {
    return this.view.byteLength - this.at;
  }

  // Moves on by some bytes and returns where they begin.
  skip(size) {
    if (!(size <= this.left)) throw new CaptureError(`${this.path} is truncated or damaged: copy it again.`);
    this.at += size;
    return this.at - size;
  }

  u8 = () => this.view.getUint8(this.skip(1));
  i8 = () => this.view.getInt8(this.skip(1));
  u16 = () => this.view.getUint16(this.skip(2), this.little);
  i16 = () => this.view.getInt16(this.skip(2), this.little);
  u32 = () => this.view.getUint32(this.skip(4), this.little);
  i32 = () => this.view.getInt32(this.skip(4), this.little);
  u64 = () => Number(this.view.getBigUint64(this.skip(8), this.little));
  i64 = () => Number(this.view.getBigInt64(this.skip(8), this.little));
  f32 = () => this.view.getFloat32(this.skip(4), this.little);
  f64 = () => this.view.getFloat64(this.skip(8), this.little);

  doubles(count) {
    return Array.from({ length: count }, this.f64);
  }

  // A number of entries that take at least `smallest` bytes each.
  count(smallest) {
    const count = this.u64();
    if (count * smallest <= this.left) return count;
    throw new CaptureError(`${this.path} is truncated or damaged: it lists more entries than it can contain.`);
  }

  // A name that ends with a zero byte.
  word() {
    const start = this.at;
    while (this.u8()) {
      if (this.at - start > LONGEST_NAME) throw new CaptureError(`${this.path} is damaged: a name in it never ends.`);
    }
    return new TextDecoder().decode(new Uint8Array(this.view.buffer, start, this.at - start - 1));
  }
}

// Lines of a text file as lists of words, without empty lines and comments: {number, line, words}.
export function* wordsOf(buffer) {
  const lines = new TextDecoder().decode(buffer).split("\n");
  for (let i = 0; i < lines.length; ++i) {
    const line = lines[i].trim();
    if (line && !line.startsWith("#")) yield { number: i + 1, line, words: line.split(/\s+/) };
  }
}

// The object in a JSON file.
export function parsedJson(buffer, path) {
  let found = null;
  try {
    found = JSON.parse(new TextDecoder().decode(buffer));
  } catch {
    throw new CaptureError(`${path} is not valid JSON: repair the file or export it again.`);
  }
  if (typeof found === "object" && found && !Array.isArray(found)) return found;
  throw new CaptureError(`${path} contains no JSON object: export it again.`);
}

// A path with slashes, without "." and "..".
export function tidy(path) {
  const parts = [];
  for (const part of path.replaceAll("\\", "/").split("/")) {
    if (part === "..") parts.pop();
    else if (part && part !== ".") parts.push(part);
  }
  return parts.join("/");
}

export const folderOf = (path) => path.slice(0, Math.max(0, path.lastIndexOf("/")));

export const nameOf = (path) => path.slice(path.lastIndexOf("/") + 1);

export const joined = (folder, path) => tidy(`${folder}/${path}`);

// Compares texts as Python does, except beyond the first 65,536 characters of Unicode.
export const ordered = (one, other) => (one < other ? -1 : one > other ? 1 : 0);

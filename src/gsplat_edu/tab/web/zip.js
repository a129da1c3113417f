// Files of a zip archive, decompressed by the browser when they are read.
// Source: PKWARE, "APPNOTE.TXT - .ZIP File Format Specification", sections 4.3.7, 4.3.12 and 4.3.16.

import { Bytes, CaptureError, tidy } from "./reading.js";

const END = 0x06054b50;
const ENTRY = 0x02014b50;
const LOCAL = 0x04034b50;
const END_BYTES = 22;
const LONGEST_COMMENT = 0xffff;
const LARGEST = 2 ** 30; // bytes of one file

const [STORED, DEFLATED] = [0, 8];
const [ENCRYPTED, UTF8] = [1, 1 << 11];

// One file of an archive, with the size and the arrayBuffer() of a Blob.
class Packed {
  constructor(archive, entry) {
    Object.assign(this, { archive, ...entry });
  }

  async arrayBuffer() {
    const head = new Bytes(await this.archive.slice(this.offset, this.offset + 30).arrayBuffer(), this.path);
    if (head.u32() !== LOCAL) throw damaged(this.path);
    head.skip(22);
    const start = this.offset + 30 + head.u16() + head.u16();
    const packed = this.archive.slice(start, start + this.packed);
    if (packed.size < this.packed) throw damaged(this.path);
    return this.method === STORED ? packed.arrayBuffer() : inflated(packed, this);
  }
}

// Whether a file begins as a zip archive does.
export async function isZip(file) {
  const head = new DataView(await file.slice(0, 4).arrayBuffer());
  return head.byteLength === 4 && [END, LOCAL].includes(head.getUint32(0, true));
}

// The files of a zip archive: [{path, file}]. Folders are left out.
export async function unzipped(archive) {
  const tail = new Bytes(await archive.slice(-END_BYTES - LONGEST_COMMENT).arrayBuffer(), "The zip file");
  let at = tail.left - END_BYTES;
  while (at >= 0 && tail.view.getUint32(at, true) !== END) --at;
  if (at < 0) throw new CaptureError("The zip file is truncated or damaged: pack it again.");
  tail.at = at + 10;
  const [count, size, offset] = [tail.u16(), tail.u32(), tail.u32()];
  if (count === 0xffff || size === 0xffffffff || offset === 0xffffffff) throw tooLarge();
  const directory = new Bytes(await archive.slice(offset, offset + size).arrayBuffer(), "The zip file");
  const files = [];
  for (let i = 0; i < count; ++i) {
    const entry = entryOf(directory);
    if (!entry.path.endsWith("/")) files.push({ path: tidy(entry.path), file: new Packed(archive, entry) });
  }
  return files;
}

function entryOf(directory) {
  if (directory.u32() !== ENTRY) throw damaged(directory.path);
  directory.skip(4);
  const [flags, method] = [directory.u16(), directory.u16()];
  directory.skip(8);
  const [packed, size] = [directory.u32(), directory.u32()];
  const [name, extra, comment] = [directory.u16(), directory.u16(), directory.u16()];
  directory.skip(8);
  const offset = directory.u32();
  const raw = new Uint8Array(directory.view.buffer, directory.skip(name), name);
  directory.skip(extra + comment);
  const path = new TextDecoder(flags & UTF8 ? "utf-8" : "latin1").decode(raw);
  if (flags & ENCRYPTED) throw new CaptureError("The zip file has a password: unpack it and drop the folder.");
  if ([packed, size, offset].includes(0xffffffff)) throw tooLarge();
  if (size > LARGEST) throw new CaptureError(`${path} in the zip file is larger than 1 GiB: leave it out.`);
  if (method !== STORED && method !== DEFLATED) {
    throw new CaptureError(`${path} is compressed in an unusual way: unpack the zip file and drop the folder.`);
  }
  return { path, method, packed, size, offset };
}

// Decompresses a file, but never more than its entry declares.
async function inflated(packed, { size, path }) {
  const whole = new Uint8Array(size);
  const reader = packed.stream().pipeThrough(new DecompressionStream("deflate-raw")).getReader();
  let at = 0;
  for (;;) {
    const { value, done } = await reader.read().catch(() => {
      throw damaged(path);
    });
    if (done) break;
    if (at + value.length > size) {
      reader.cancel().catch(() => {});
      throw damaged(path);
    }
    whole.set(value, at);
    at += value.length;
  }
  if (at < size) throw damaged(path);
  return whole.buffer;
}

const damaged = (path) => new CaptureError(`${path} is damaged in the zip file: pack it again.`);

const tooLarge = () => new CaptureError("The zip file is larger than 4 GiB (zip64): unpack it and drop the folder.");

// Runs the WebAssembly module in node for tests and benchmarks in Python: a request of JSON a line on the standard input, an answer a line back.
// Arrays travel as { type, bytes (base64) }.

import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";

const web = process.argv[2];
const engine = await import(`${web}/engine.js`);
const compiled = await WebAssembly.compile(readFileSync(`${web}/gsplat_edu.wasm`));
const KINDS = { Float64Array, Float32Array, Uint8Array };

function unpacked(value) {
  if (Array.isArray(value)) return value.map(unpacked);
  if (value === null || typeof value !== "object") return value;
  if (value.type in KINDS) {
    const bytes = Buffer.from(value.bytes, "base64");
    return new KINDS[value.type](bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
  }
  return Object.fromEntries(Object.entries(value).map(([name, each]) => [name, unpacked(each)]));
}

function packed(value) {
  if (ArrayBuffer.isView(value)) {
    const bytes = Buffer.from(value.buffer, value.byteOffset, value.byteLength);
    return { type: value.constructor.name, bytes: bytes.toString("base64") };
  }
  if (Array.isArray(value)) return value.map(packed);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([name, each]) => [name, packed(each)]));
}

let module = null;
let trainer = null;
const calls = {
  load: async ({ limit }) => {
    module = await engine.loadModule(compiled, limit ? { limit } : {});
    return { bytes: module.bytes };
  },
  render: ({ gaussians, camera, settings, upstream }) => engine.render(module, gaussians, camera, settings, upstream),
  recipe: ({ iterations, changes }) => engine.recipe(iterations, changes),
  planned: ({ pixels, views, separate }) => engine.plannedGaussians(pixels, views, separate),
  extent: ({ cameras }) => engine.sceneExtent(cameras),
  train: (options) => {
    trainer = new engine.Trainer(module, options);
    return { planned: trainer.planned, count: trainer.count };
  },
  step: ({ count }) => trainer.step(count),
  score: ({ view }) => trainer.score(view),
  picture: ({ camera }) => trainer.render(camera),
  gaussians: () => trainer.gaussians(),
  state: () => trainer.state(),
  resume: ({ state }) => trainer.load(state),
  facts: () => ({
    imports: WebAssembly.Module.imports(compiled).map(({ module, name }) => `${module}.${name}`),
    bytes: module?.bytes ?? 0,
    seconds: (process.cpuUsage().user + process.cpuUsage().system) / 1e6,
  }),
};

for await (const line of createInterface({ input: process.stdin })) {
  const { call, ...given } = unpacked(JSON.parse(line));
  let answer;
  try {
    answer = { value: packed((await calls[call](given)) ?? null) };
  } catch (error) {
    answer = { error: error.message, kind: error.name };
  }
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}

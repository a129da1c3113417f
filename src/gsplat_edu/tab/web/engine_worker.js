// One thread of the WebAssembly module: an instance that shares the memory of the first one, and helps whenever that computes.

import { importsOf } from "./engine.js";

async function run({ compiled, memory, id, stack, locals }) {
  const { exports } = await WebAssembly.instantiate(compiled, importsOf(memory));
  exports.__stack_pointer.value = stack;
  exports.__wasm_init_tls(locals);
  self.postMessage("ready");
  exports.work(id);
}

self.onmessage = ({ data }) => run(data);

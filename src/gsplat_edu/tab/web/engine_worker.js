// One thread of the WebAssembly module: an instance with the memory of the first one, which takes part in its rounds for ever.

import { importsOf } from "./engine.js";

async function run({ compiled, memory, id, stack, locals }) {
  const { exports } = await WebAssembly.instantiate(compiled, importsOf(memory));
  exports.__stack_pointer.value = stack;
  exports.__wasm_init_tls(locals);
  self.postMessage("ready");
  exports.work(id);
}

self.onmessage = ({ data }) => run(data);

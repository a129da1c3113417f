// A host of the engine's programs in a browser: it plays what `passes.manifest` describes, as host.py does from Python.

const WORD = 4, JOB_BYTES = 32, SLICE = 256, VIEW_BYTES = 640, LEAST = 4;

const sizeOf = (size, counts) => size.words * Math.ceil(counts[size.count] / size.per);

function jobOf(one, counts, block, first) {
    const count = sizeOf(one.items, counts);
    return [count, one.live, Math.ceil(count / (one.group || block)), one.shift, first];
}

// The dispatches of a part: each pass in stretches of at most so many workgroups.
function stretchesOf(passes, counts, block, most) {
    const found = [];
    for (const one of passes) {
        const groups = one.group ? jobOf(one, counts, block, 0)[2] : 1;
        for (let first = 0; first < groups; first += most)
            found.push({one, job: jobOf(one, counts, block, first), groups: Math.min(most, groups - first)});
    }
    return found;
}

const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

function textOf(bytes) {
    let text = '';
    for (let at = 0; at < bytes.length; at += 8192) text += String.fromCharCode(...bytes.subarray(at, at + 8192));
    return btoa(text);
}

async function deviceFor(manifest, notes) {
    const adapter = await navigator.gpu?.requestAdapter();
    if (!adapter) return null;
    const device = await adapter.requestDevice();  // the default limits
    device.addEventListener('uncapturederror', (event) => notes.push(event.error.message));
    return device;
}

async function compiled(device, manifest, notes) {
    const modules = {};
    for (const [name, code] of Object.entries(manifest.modules)) {
        modules[name] = device.createShaderModule({code});
        for (const message of (await modules[name].getCompilationInfo()).messages)
            notes.push(`${name}:${message.lineNum}: ${message.type}: ${message.message}`);
    }
    return modules;
}

// Plays the parts in order; `writes` is name to base64, `view` base64. Every `most` workgroups are a submission; 0 plays a
// part in one. Resolves to the buffers of `reads`, and what went wrong.
async function play(manifest, counts, writes, view, parts, reads, most = 0) {
    const notes = [], device = await deviceFor(manifest, notes);
    if (!device) return {adapter: false};
    const modules = await compiled(device, manifest, notes);
    const storage = GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC | GPUBufferUsage.COPY_DST;
    const buffers = {};
    for (const {name, size} of manifest.buffers) {
        const words = Math.max(LEAST, sizeOf(size, counts));
        buffers[name] = device.createBuffer({size: WORD * words, usage: storage});
    }
    for (const [name, text] of Object.entries(writes)) device.queue.writeBuffer(buffers[name], 0, bytesOf(text));
    const shared = device.createBuffer({size: VIEW_BYTES, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST});
    device.queue.writeBuffer(shared, 0, bytesOf(view));
    const entry = (binding, buffer) => ({binding, visibility: GPUShaderStage.COMPUTE, buffer});
    const uniformLayout = device.createBindGroupLayout({entries: [
        entry(0, {type: 'uniform', hasDynamicOffset: true, minBindingSize: JOB_BYTES}),
        entry(1, {type: 'uniform', minBindingSize: VIEW_BYTES}),
    ]});
    for (const part of parts) {
        const stretches = stretchesOf(manifest.parts[part], counts, manifest.block, most || Infinity);
        const jobs = device.createBuffer({size: SLICE * stretches.length, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST});
        const uniforms = device.createBindGroup({layout: uniformLayout, entries: [
            {binding: 0, resource: {buffer: jobs, size: JOB_BYTES}},
            {binding: 1, resource: {buffer: shared}},
        ]});
        stretches.forEach(({job}, row) => device.queue.writeBuffer(jobs, SLICE * row, new Uint32Array(job)));
        let encoder = device.createCommandEncoder(), computing = encoder.beginComputePass();
        const submit = () => {
            computing.end();
            device.queue.submit([encoder.finish()]);
        };
        const bound = new Map();
        stretches.forEach(({one, groups}, row) => {
            const names = [...one.reads, ...one.writes];
            if (!bound.has(one)) {
                const layout = device.createBindGroupLayout({entries: names.map((_, binding) =>
                    entry(binding, {type: binding < one.reads.length ? 'read-only-storage' : 'storage'}))});
                const pipeline = device.createComputePipeline({
                    layout: device.createPipelineLayout({bindGroupLayouts: [uniformLayout, layout]}),
                    compute: {module: modules[one.module], entryPoint: one.entry},
                });
                const storage = device.createBindGroup({layout, entries: names.map((name, binding) =>
                    ({binding, resource: {buffer: buffers[name]}}))});
                bound.set(one, {pipeline, storage});
            }
            const {pipeline, storage} = bound.get(one);
            computing.setPipeline(pipeline);
            computing.setBindGroup(0, uniforms, [SLICE * row]);
            computing.setBindGroup(1, storage);
            const x = Math.min(groups, device.limits.maxComputeWorkgroupsPerDimension);
            computing.dispatchWorkgroups(x, Math.ceil(groups / x));
            if (most && row + 1 < stretches.length) {
                submit();
                encoder = device.createCommandEncoder();
                computing = encoder.beginComputePass();
            }
        });
        submit();
    }
    const found = {};
    for (const name of reads) {
        const staging = device.createBuffer({size: buffers[name].size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST});
        const encoder = device.createCommandEncoder();
        encoder.copyBufferToBuffer(buffers[name], 0, staging, 0, buffers[name].size);
        device.queue.submit([encoder.finish()]);
        await staging.mapAsync(GPUMapMode.READ);
        found[name] = textOf(new Uint8Array(staging.getMappedRange()));
    }
    return {adapter: true, notes, found};
}

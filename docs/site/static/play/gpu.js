// Plays the engine's programs in the reader's browser through WebGPU: the description is that of engine/passes.py, the shaders
// are the package's. Where there is no WebGPU a figure computes in JavaScript and says so.
"use strict";

gsplatPlay.gpu = (() => {
    const WORD = 4, JOB_BYTES = 32, SLICE = 256, VIEW_BYTES = 640, LEAST = 4; // as in engine/dispatch.py
    let opening = null;

    /** Resolve to the browser's device, or to null. All figures of a page share it. */
    function device() {
        opening ??= (async () => {
            const adapter = await navigator.gpu?.requestAdapter();
            if (!adapter) return null;
            const opened = await adapter.requestDevice(); // the limits that every browser grants
            opened.lost.then(() => (opening = null));
            return opened;
        })();
        return opening;
    }

    const sizeOf = (size, counts) => size.words * Math.ceil(counts[size.count] / size.per);

    /** The five numbers of a pass that job.wgsl names, and its workgroups. */
    function jobOf(one, counts, block) {
        const count = sizeOf(one.items, counts), blocks = Math.ceil(count / (one.group || block));
        return { job: [count, one.live, blocks, one.shift, 0], groups: one.group ? blocks : 1 };
    }

    const entry = (binding, buffer) => ({ binding, visibility: GPUShaderStage.COMPUTE, buffer });

    function uniformLayout(gpu) {
        return gpu.createBindGroupLayout({ entries: [
            entry(0, { type: "uniform", hasDynamicOffset: true, minBindingSize: JOB_BYTES }),
            entry(1, { type: "uniform", minBindingSize: VIEW_BYTES }),
        ] });
    }

    /** Make the pipeline of a pass and bind its buffers. */
    function bound(gpu, one, uniforms, modules, buffers) {
        const names = [...one.reads, ...one.writes];
        const kind = (place) => (place < one.reads.length ? "read-only-storage" : "storage");
        const layout = gpu.createBindGroupLayout({ entries: names.map((_, place) => entry(place, { type: kind(place) })) });
        const pipeline = gpu.createComputePipeline({
            layout: gpu.createPipelineLayout({ bindGroupLayouts: [uniforms, layout] }),
            compute: { module: modules[one.module], entryPoint: one.entry },
        });
        const entries = names.map((name, binding) => ({ binding, resource: { buffer: buffers[name] } }));
        return { pipeline, storage: gpu.createBindGroup({ layout, entries }) };
    }

    /** Make the buffers, pipelines and dispatches of a program for these counts; `play` repeats them. */
    function prepared(gpu, program, counts) {
        const use = GPUBufferUsage, buffers = {}, modules = {}, parts = {};
        for (const { name, size } of program.buffers) {
            const bytes = WORD * Math.max(LEAST, sizeOf(size, counts));
            buffers[name] = gpu.createBuffer({ size: bytes, usage: use.STORAGE | use.COPY_SRC | use.COPY_DST });
        }
        for (const [name, code] of Object.entries(program.modules)) modules[name] = gpu.createShaderModule({ code });
        const shared = gpu.createBuffer({ size: VIEW_BYTES, usage: use.UNIFORM | use.COPY_DST });
        const uniforms = uniformLayout(gpu);
        for (const [part, passes] of Object.entries(program.parts)) {
            const jobs = gpu.createBuffer({ size: SLICE * passes.length, usage: use.UNIFORM | use.COPY_DST });
            const group = gpu.createBindGroup({ layout: uniforms, entries: [
                { binding: 0, resource: { buffer: jobs, size: JOB_BYTES } },
                { binding: 1, resource: { buffer: shared } },
            ] });
            parts[part] = passes.map((one, row) => {
                const { job, groups } = jobOf(one, counts, program.block);
                gpu.queue.writeBuffer(jobs, SLICE * row, new Uint32Array(job));
                return { group, groups, offset: SLICE * row, ...bound(gpu, one, uniforms, modules, buffers) };
            });
        }
        return { buffers, shared, parts };
    }

    async function read(gpu, buffers, names) {
        const staging = {}, encoder = gpu.createCommandEncoder(), found = {};
        for (const name of names) {
            const { size } = buffers[name];
            staging[name] = gpu.createBuffer({ size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
            encoder.copyBufferToBuffer(buffers[name], 0, staging[name], 0, size);
        }
        gpu.queue.submit([encoder.finish()]);
        for (const name of names) {
            await staging[name].mapAsync(GPUMapMode.READ);
            found[name] = staging[name].getMappedRange().slice(0);
            staging[name].destroy();
        }
        return found;
    }

    /** Play parts of a program: `writes` are typed arrays by buffer, `view` the uniform block. Buffers come back as bytes. */
    async function play(kept, gpu, { program, counts, writes, view, parts, reads }) {
        const key = JSON.stringify(counts);
        if (kept.key !== key || kept.gpu !== gpu) Object.assign(kept, { key, gpu, ...prepared(gpu, program, counts) });
        gpu.queue.writeBuffer(kept.shared, 0, view);
        for (const [name, array] of Object.entries(writes)) gpu.queue.writeBuffer(kept.buffers[name], 0, array);
        const encoder = gpu.createCommandEncoder(), pass = encoder.beginComputePass();
        let passes = 0, groups = 0;
        for (const part of parts) {
            for (const call of kept.parts[part]) {
                pass.setPipeline(call.pipeline);
                pass.setBindGroup(0, call.group, [call.offset]);
                pass.setBindGroup(1, call.storage);
                pass.dispatchWorkgroups(call.groups);
                passes += 1;
                groups += call.groups;
            }
        }
        pass.end();
        gpu.queue.submit([encoder.finish()]);
        return { found: await read(gpu, kept.buffers, reads), passes, groups };
    }

    /** A figure's way to the GPU: runs the newest job, one at a time; `done` gets its result, or null and the reason. */
    function runner(done) {
        const kept = {};
        let waiting = null, running = null;
        async function loop() {
            while (waiting) {
                const job = waiting;
                waiting = null;
                let result = null, reason = "This browser has no WebGPU: JavaScript computes the picture.";
                try {
                    const gpu = await device();
                    if (gpu) result = await play(kept, gpu, job);
                } catch (error) {
                    reason = `WebGPU failed (${error.message}): JavaScript computes the picture.`;
                }
                if (!waiting) done(result, reason, job);
            }
            running = null;
        }
        return {
            run(job) {
                waiting = job;
                running ??= loop();
            },
            idle: async () => { while (running) await running; },
        };
    }

    return { runner };
})();

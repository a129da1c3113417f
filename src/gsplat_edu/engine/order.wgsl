// order: list the Gaussians that are drawn, and give each its slots in depth order.
//
// `list_seen` moves their depths and numbers to the places that the scan of `seen` found; the depth of a drawn Gaussian is
// positive, so its bits sort as it does. After the sort, `gather_spans` takes the numbers of tiles in depth order, whose
// running sums are the first slots.

@group(1) @binding(0) var<storage, read> records_in: array<vec4<f32>>;
@group(1) @binding(1) var<storage, read> places: array<u32>;
@group(1) @binding(2) var<storage, read_write> depth_keys: array<u32>;
@group(1) @binding(3) var<storage, read_write> order_out: array<u32>;

@group(1) @binding(0) var<storage, read> live: array<u32>;
@group(1) @binding(1) var<storage, read> order: array<u32>;
@group(1) @binding(2) var<storage, read> spans: array<vec2<u32>>;
@group(1) @binding(3) var<storage, read> records: array<vec4<f32>>;
@group(1) @binding(4) var<storage, read_write> starts: array<u32>;
@group(1) @binding(5) var<storage, read_write> radii: array<vec2<f32>>;

@compute @workgroup_size(256)
fn list_seen(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) thread: u32) {
    let i = group_of(id, groups) * 256u + thread;
    if (i >= job.count) {
        return;
    }
    let depth = records_in[4u * i + 2u].w;
    if (depth > 0.0) {
        depth_keys[places[i]] = bitcast<u32>(depth);
        order_out[places[i]] = i;
    }
}

@compute @workgroup_size(256)
fn gather_spans(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                @builtin(local_invocation_index) thread: u32) {
    let k = group_of(id, groups) * 256u + thread;
    if (k >= job.count) {
        return;
    }
    starts[k] = 0u;
    if (k < live[job.live]) {
        let i = order[k];
        starts[k] = spans[i].x;
        radii[k] = records[4u * i + 3u].zw;
    }
}

// How many tiles does each splat meet? One invocation is one splat; nobody else writes its count.

@group(1) @binding(0) var<storage, read> records: array<vec4<f32>>;
@group(1) @binding(1) var<storage, read_write> spans: array<vec2<u32>>;
@group(1) @binding(2) var<storage, read_write> starts: array<u32>;
@group(1) @binding(3) var<storage, read_write> order: array<u32>;

@compute @workgroup_size(64)
fn count(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) thread: u32) {
    let i = 64u * group_of(id, groups) + thread;
    if (i >= job.count) {
        return;
    }
    var total = 0;
    let e = ellipse_of(records[4u * i], records[4u * i + 1u], records[4u * i + 3u]);
    for (var row = e.first; row <= e.last; row++) {
        total += columns_of(e, row).y;
    }
    spans[i] = vec2<u32>(u32(total), 0u);
    starts[i] = u32(total);                           // the scan turns these into places
    order[i] = i;                                     // the splats are in order of depth already
}

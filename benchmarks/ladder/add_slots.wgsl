// Add up the slots of each splat, first to last: one invocation is one splat, so nobody else adds to its sums.

@group(1) @binding(0) var<storage, read> spans: array<vec2<u32>>;      // number of slots, and the first
@group(1) @binding(1) var<storage, read> slots: array<f32>;
@group(1) @binding(2) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn add_slots(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) thread: u32) {
    let i = 64u * group_of(id, groups) + thread;
    if (i >= job.count) {
        return;
    }
    for (var k = 0u; k < 10u; k++) {
        var sum = 0.0;
        for (var slot = spans[i].y; slot < spans[i].y + spans[i].x; slot++) {
            sum += slots[10u * slot + k];
        }
        sums[10u * i + k] = sum;
    }
}

// features: composite four features of each Gaussian in place of colour and depth, and collect their gradients.
//
//     image = sum w f;   dL/df = sum over the Gaussian's slots of w g
//
// `paint` copies the records with features instead of colours. After composite_backward on them, `add_moments` adds what
// alpha got from the features to the pairs' slots, and `sum_features` adds each Gaussian's slots in order.

const SLOT = 10u;

@group(1) @binding(0) var<storage, read> records: array<vec4<f32>>;
@group(1) @binding(1) var<storage, read> features: array<vec4<f32>>;
@group(1) @binding(2) var<storage, read_write> painted: array<vec4<f32>>;

@group(1) @binding(0) var<storage, read> live: array<u32>;
@group(1) @binding(1) var<storage, read> feature_slots: array<f32>;
@group(1) @binding(2) var<storage, read_write> slots: array<f32>;

@group(1) @binding(0) var<storage, read> spans: array<vec2<u32>>;
@group(1) @binding(2) var<storage, read_write> feature_grads: array<vec4<f32>>;

@compute @workgroup_size(256)
fn paint(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) thread: u32) {
    let i = group_of(id, groups) * 256u + thread;
    if (i < job.count) {
        painted[4u * i] = records[4u * i];
        painted[4u * i + 1u] = records[4u * i + 1u];
        painted[4u * i + 2u] = features[i];
        painted[4u * i + 3u] = records[4u * i + 3u];
    }
}

@compute @workgroup_size(256)
fn add_moments(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) thread: u32) {
    let k = group_of(id, groups) * 256u + thread;
    if (k < min(job.count, live[job.live])) {
        for (var j = 4u; j < SLOT; j++) {
            slots[k * SLOT + j] += feature_slots[k * SLOT + j];
        }
    }
}

@compute @workgroup_size(64)
fn sum_features(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                @builtin(local_invocation_index) thread: u32) {
    let i = group_of(id, groups) * 64u + thread;
    if (i >= job.count) {
        return;
    }
    var sum = vec4<f32>(0.0);
    for (var k = 0u; k < spans[i].x; k++) {
        let at = (spans[i].y + k) * SLOT;
        sum += vec4<f32>(feature_slots[at], feature_slots[at + 1u], feature_slots[at + 2u], feature_slots[at + 3u]);
    }
    feature_grads[i] = sum;
}

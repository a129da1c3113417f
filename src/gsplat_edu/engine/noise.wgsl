// noise: move the means at random along their covariances, faint Gaussians most.
//
//     mean += amount sigmoid(k (t - opacity)) Sigma n,   n = (r cos 2 pi v, r sin 2 pi v, r' cos 2 pi v'),   r = sqrt(-2 log u)
//
// Philox maps the seed and the Gaussian's number to four words; their upper 24 bits are u, v, u' and v'. WGSL has no product
// of 64 bits, so its upper half is put together from four of 16 by 16.

@group(1) @binding(0) var<storage, read> live: array<u32>;
@group(1) @binding(1) var<storage, read_write> core: array<f32>;

const CORE = 14u;
const SHUT = 60.0;           // a gate below exp(-60) counts as 0
const STEPS = 16777216.0;    // 2^24

fn upper_product(a: u32, b: u32) -> u32 {
    let low = (a & 0xffffu) * (b & 0xffffu);
    let first = (a >> 16u) * (b & 0xffffu) + (low >> 16u);
    let second = (a & 0xffffu) * (b >> 16u) + (first & 0xffffu);
    return (a >> 16u) * (b >> 16u) + (first >> 16u) + (second >> 16u);
}

fn philox(start: vec4<u32>, seed: vec2<u32>) -> vec4<u32> {
    var c = start;
    var k = seed;
    for (var round_ = 0u; round_ < 10u; round_++) {
        let a = c.x;
        let b = c.z;
        c = vec4<u32>(upper_product(b, 0xCD9E8D57u) ^ c.y ^ k.x, b * 0xCD9E8D57u,
                      upper_product(a, 0xD2511F53u) ^ c.w ^ k.y, a * 0xD2511F53u);
        k += vec2<u32>(0x9E3779B9u, 0xBB67AE85u);
    }
    return c;
}

fn normals(i: u32) -> vec3<f32> {
    let words = philox(vec4<u32>(i, 0u, 0u, 0u), view.numbers[SEED].xy);
    let w = vec4<f32>(words >> vec4<u32>(8u));
    let r = sqrt(-2.0 * log_exact((w.x + 1.0) / STEPS));
    let other_r = sqrt(-2.0 * log_exact((w.z + 1.0) / STEPS));
    return vec3<f32>(r * turned(w.y / STEPS), other_r * turned(w.w / STEPS).x);
}

@compute @workgroup_size(256)
fn add_noise(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) lane: u32) {
    let i = group_of(id, groups) * 256u + lane;
    if (i >= job.count || live[HALT] != 0u) {
        return;
    }
    let at = i * CORE;
    let mean = vec3<f32>(core[at], core[at + 1u], core[at + 2u]);
    let noise = floats_at(NOISE);
    let opacity = 1.0 / (1.0 + exp_exact(clamp(-core[at + 13u], -SCALE_MOST, SCALE_MOST)));
    let x = noise.y * (opacity - noise.z);
    if (x > SHUT || is_far(mean)) {
        return;
    }
    let gate = 1.0 / (1.0 + exp_exact(max(x, -SCALE_MOST)));
    let raw = vec4<f32>(core[at + 3u], core[at + 4u], core[at + 5u], core[at + 6u]);
    let R = rotation(raw / sqrt(dot(raw, raw)));
    let logs = vec3<f32>(core[at + 7u], core[at + 8u], core[at + 9u]);
    let low = clamp(logs, vec3<f32>(-SCALE_MOST), vec3<f32>(0.5 * SCALE_MOST));
    let s = vec3<f32>(exp_exact(low.x), exp_exact(low.y), exp_exact(low.z));
    let moved = mean + noise.x * gate * (R * (s * s * (normals(i) * R)));      // a row times R: R' n
    if (finite3(moved)) {
        core[at] = moved.x;
        core[at + 1u] = moved.y;
        core[at + 2u] = moved.z;
    }
}

// adam: move all parameters by their gradients, and collect what density control needs.
//
//     m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g²;   p -= rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)
//
// `penalties` sums opacities and scales before they move; their gradients, w o (1 - o) / count and w s / 3N, are added
// here. If few Gaussians are visible, opacities are averaged over those. Statistics: the norm of the gradient of the position
// in the image, and the number of views that show the Gaussian.
// `gate` sets HALT if there was no room for the pairs; then nothing below changes anything until the host clears it.

const CORE = 14u;
const OUT = 16u;

@group(1) @binding(0) var<storage, read_write> live_out: array<u32>;

@group(1) @binding(0) var<storage, read> core_in: array<f32>;
@group(1) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(1) @binding(2) var<storage, read> live: array<u32>;
@group(1) @binding(3) var<storage, read_write> penalty_sums: array<vec2<f32>>;

@group(1) @binding(0) var<storage, read> sums_in: array<vec2<f32>>;
@group(1) @binding(1) var<storage, read_write> totals: array<u32>;

@group(1) @binding(0) var<storage, read> core_grads: array<f32>;
@group(1) @binding(3) var<storage, read_write> core: array<f32>;
@group(1) @binding(4) var<storage, read_write> core_first: array<f32>;
@group(1) @binding(5) var<storage, read_write> core_second: array<f32>;
@group(1) @binding(6) var<storage, read_write> statistics: array<vec2<f32>>;

@group(1) @binding(0) var<storage, read> rest_grads: array<f32>;
@group(1) @binding(1) var<storage, read> live_of_rest: array<u32>;
@group(1) @binding(2) var<storage, read_write> rest: array<f32>;
@group(1) @binding(3) var<storage, read_write> rest_first: array<f32>;
@group(1) @binding(4) var<storage, read_write> rest_second: array<f32>;

var<workgroup> parts: array<vec2<f32>, 256>;

fn sigmoid(x: f32) -> f32 {
    return 1.0 / (1.0 + exp_exact(clamp(-x, -SCALE_MOST, SCALE_MOST)));
}

fn scale_of(x: f32) -> f32 {
    return exp_exact(clamp(x, -SCALE_MOST, SCALE_MOST));
}

// Returns the sum of all threads' parts in a fixed order, to all of them.
fn add_parts(mine: vec2<f32>, lane: u32) -> vec2<f32> {
    parts[lane] = mine;
    workgroupBarrier();
    for (var reach = 128u; reach > 0u; reach /= 2u) {
        if (lane < reach) {
            parts[lane] += parts[lane + reach];
        }
        workgroupBarrier();
    }
    return parts[0];
}

@compute @workgroup_size(1)
fn gate() {
    if (live_out[job.live] > job.count) {
        live_out[HALT] = 1u;
    }
}

@compute @workgroup_size(256)
fn penalties(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) lane: u32) {
    let block = group_of(id, groups);
    let i = block * 256u + lane;
    var mine = vec2<f32>(0.0);
    if (i < job.count) {
        let at = i * CORE;
        let some = live[VISIBLE] < view.numbers[RULES].x;
        if (!some || records[4u * i + 2u].w > 0.0) {
            mine.x = sigmoid(core_in[at + 13u]);
        }
        if (!is_far(vec3<f32>(core_in[at], core_in[at + 1u], core_in[at + 2u]))) {
            mine.y = scale_of(core_in[at + 7u]) + scale_of(core_in[at + 8u]) + scale_of(core_in[at + 9u]);
        }
    }
    let sum = add_parts(mine, lane);
    if (lane == 0u && block < job.blocks) {
        penalty_sums[block] = sum;
    }
}

// Adds all items of `sums_in`, to two words of `live`.
@compute @workgroup_size(256)
fn total(@builtin(local_invocation_index) lane: u32) {
    var mine = vec2<f32>(0.0);
    for (var k = lane; k < job.count; k += 256u) {
        mine += sums_in[k];
    }
    let sum = add_parts(mine, lane);
    if (lane == 0u) {
        totals[job.live] = bitcast<u32>(sum.x);
        totals[job.live + 1u] = bitcast<u32>(sum.y);
    }
}

struct Moved {
    p: f32,
    m: f32,
    v: f32,
}

fn moved(p: f32, m: f32, v: f32, g: f32, by: Rates) -> Moved {
    let m1 = by.b1 * m + by.new1 * g;
    let v1 = by.b2 * v + by.new2 * g * g;
    return Moved(p - by.rate * (m1 / by.correction1) / (sqrt(v1 / by.correction2) + by.eps), m1, v1);
}

fn move_core(place: u32, g: f32, by: Rates) {
    let next = moved(core[place], core_first[place], core_second[place], g, by);
    core[place] = next.p;
    core_first[place] = next.m;
    core_second[place] = next.v;
}

fn opacity_gradient(logit: f32, visible: bool) -> f32 {
    let some = live[VISIBLE] < view.numbers[RULES].x;
    let o = sigmoid(logit);
    let count = f32(max(select(job.count, live[VISIBLE], some), 1u));
    return select(floats_at(WEIGHTS).z * o * (1.0 - o) / count, 0.0, some && !visible);
}

@compute @workgroup_size(64)
fn gaussian_step(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                 @builtin(local_invocation_index) lane: u32) {
    let i = group_of(id, groups) * 64u + lane;
    if (i >= job.count || live[HALT] != 0u) {
        return;
    }
    let at = i * CORE;
    let from_ = i * OUT;
    let visible = records[4u * i + 2u].w > 0.0;
    if (visible && view.numbers[RULES].y != 0u) {
        statistics[i] += vec2<f32>(core_grads[from_ + 14u], 1.0);
    }
    let far = is_far(vec3<f32>(core[at], core[at + 1u], core[at + 2u]));
    let scale_weight = select(floats_at(WEIGHTS).w, 0.0, far);
    let for_means = rates_of(MEANS);
    let for_scales = rates_of(SCALES);
    let for_colors = rates_of(COLORS);
    for (var k = 0u; k < 3u; k++) {
        move_core(at + k, core_grads[from_ + k], for_means);
        let penalty = scale_weight * scale_of(core[at + 7u + k]);
        move_core(at + 7u + k, core_grads[from_ + 7u + k] + penalty, for_scales);
        move_core(at + 10u + k, core_grads[from_ + 10u + k], for_colors);
    }
    let for_quats = rates_of(QUATS);
    for (var k = 3u; k < 7u; k++) {
        move_core(at + k, core_grads[from_ + k], for_quats);
    }
    let penalty = opacity_gradient(core[at + 13u], visible);
    move_core(at + 13u, core_grads[from_ + 13u] + penalty, rates_of(LOGITS));
}

@compute @workgroup_size(256)
fn rest_step(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) lane: u32) {
    let k = group_of(id, groups) * 256u + lane;
    if (k >= job.count || live_of_rest[HALT] != 0u) {
        return;
    }
    let next = moved(rest[k], rest_first[k], rest_second[k], rest_grads[k], rates_of(HARMONICS));
    rest[k] = next.p;
    rest_first[k] = next.m;
    rest_second[k] = next.v;
}

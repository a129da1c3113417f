// statistics: what a backward pass can tell about each Gaussian, besides gradients.
//
//     sums over the pixels of |dL/du|, |dL/dv|, w, 1 where w > 0, and w e with the pixel's error e; the largest w
//
// With p = log2 o - s² - t²: dL/du = 2 ln 2 sx (h s), dL/dv = 2 ln 2 (sy h s + ty h t), each pixel's by itself.
// `weigh` prepares the pixels, `collect` goes through a tile as composite_backward does and writes the sums of each pair to
// its slot, and `sum_statistics` adds each Gaussian's slots in order.

const STATISTICS = 6u;
const WEIGHED = 6u;          // g (3), gz, R, e

@group(1) @binding(0) var<storage, read> image: array<f32>;
@group(1) @binding(1) var<storage, read> grads: array<f32>;       // image 3, transmittance, depth; by pixel
@group(1) @binding(2) var<storage, read> errors: array<f32>;
@group(1) @binding(3) var<storage, read_write> weighed: array<f32>;

@group(1) @binding(0) var<storage, read> records: array<vec4<f32>>;
@group(1) @binding(1) var<storage, read> owner: array<u32>;
@group(1) @binding(2) var<storage, read> slot_of: array<u32>;
@group(1) @binding(3) var<storage, read> tiles: array<u32>;
@group(1) @binding(4) var<storage, read> done: array<u32>;
@group(1) @binding(5) var<storage, read> weighed_in: array<f32>;
@group(1) @binding(6) var<storage, read_write> statistic_slots: array<f32>;

@group(1) @binding(0) var<storage, read> spans: array<vec2<u32>>;
@group(1) @binding(1) var<storage, read> statistic_slots_in: array<f32>;
@group(1) @binding(2) var<storage, read_write> collected: array<f32>;

const PIXELS = 256u;

var<workgroup> light: array<vec2<f32>, PIXELS>;                   // T, R
var<workgroup> upstream: array<vec4<f32>, PIXELS>;                // g, gz
var<workgroup> error: array<f32, PIXELS>;

struct Sums {
    steep: vec2<f32>,        // |h s|, |h (sy s + ty t)|
    weight: f32,
    pixels: f32,
    wrong: f32,
    largest: f32,
}

@compute @workgroup_size(256)
fn weigh(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) thread: u32) {
    let pixel = group_of(id, groups) * 256u + thread;
    if (pixel >= job.count) {
        return;
    }
    let drawn = vec4<f32>(image[6u * pixel], image[6u * pixel + 1u], image[6u * pixel + 2u], image[6u * pixel + 4u]);
    let g = vec4<f32>(grads[5u * pixel], grads[5u * pixel + 1u], grads[5u * pixel + 2u], grads[5u * pixel + 4u]);
    let at = WEIGHED * pixel;
    for (var k = 0u; k < 4u; k++) {
        weighed[at + k] = g[k];
    }
    weighed[at + 4u] = dot(g, drawn) + grads[5u * pixel + 3u] * image[6u * pixel + 3u];
    weighed[at + 5u] = errors[pixel];
}

fn load_pixel(tile: u32, lane: u32) {
    let at = pixel_of(tile, lane);
    light[lane] = vec2<f32>(0.0);
    upstream[lane] = vec4<f32>(0.0);
    error[lane] = 0.0;
    if (at.x < view.size.x && at.y < view.size.y) {
        let k = WEIGHED * (at.y * view.size.x + at.x);
        upstream[lane] = vec4<f32>(weighed_in[k], weighed_in[k + 1u], weighed_in[k + 2u], weighed_in[k + 3u]);
        light[lane] = vec2<f32>(1.0, weighed_in[k + 4u]);
        error[lane] = weighed_in[k + 5u];
    }
}

// Takes one splat in one pixel.
fn add_pixel(splat: Splat, tile: u32, lane: u32, sums: ptr<function, Sums>) {
    let d = vec2<f32>(pixel_of(tile, lane)) - splat.a.xy;
    let power = power_at(splat.a, splat.b, d);
    let at = light[lane];
    if (power >= LOG2_ALPHA_MIN && at.x > 0.0) {
        let share = share_of(power, at, upstream[lane], splat.paint);
        light[lane] = share.left;
        let s = splat.b.y + splat.a.z * d.x + splat.a.w * d.y;
        let t = splat.b.z + splat.b.x * d.y;
        (*sums).steep += abs(share.h * vec2<f32>(s, splat.a.w * s + splat.b.x * t));
        (*sums).weight += share.w;
        (*sums).pixels += select(0.0, 1.0, share.w > 0.0);
        (*sums).wrong += share.w * error[lane];
        (*sums).largest = max((*sums).largest, share.w);
    }
}

fn store_sums(slot: u32, sums: Sums, sx: f32) {
    let at = slot * STATISTICS;
    statistic_slots[at] = 2.0 * LN2 * abs(sx) * sums.steep.x;
    statistic_slots[at + 1u] = 2.0 * LN2 * sums.steep.y;
    statistic_slots[at + 2u] = sums.weight;
    statistic_slots[at + 3u] = sums.pixels;
    statistic_slots[at + 4u] = sums.wrong;
    statistic_slots[at + 5u] = sums.largest;
}

// A workgroup takes a tile; one more than there are tiles clears the slots that belong to none.
@compute @workgroup_size(64)
fn collect(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
           @builtin(local_invocation_index) thread: u32) {
    let tile = group_of(id, groups);
    if (tile > view.tiles) {
        return;
    }
    let begin = tiles[tile];
    let end = tiles[tile + 1u];
    var stop = begin;
    if (tile < view.tiles) {
        stop = begin + done[tile];
        for (var lane = thread; lane < PIXELS; lane += BATCH) {
            load_pixel(tile, lane);
        }
    }
    workgroupBarrier();
    for (var k = begin; k < stop; k += BATCH) {
        let count = min(BATCH, stop - k);
        let mine = thread < count;
        var splat: Splat;
        var slot = 0u;
        if (mine) {
            slot = slot_of[k + thread];
            let i = owner[slot];
            let a = placed(records[4u * i], pixel_of(tile, 0u).x);
            splat = Splat(a, records[4u * i + 1u], records[4u * i + 2u]);
        }
        var sums = Sums(vec2<f32>(0.0), 0.0, 0.0, 0.0, 0.0);
        for (var turn = 0u; turn < PIXELS + count - 1u; turn++) {
            let lane = turn - thread;          // wraps around to a large number before the thread begins
            if (mine && lane < PIXELS) {
                add_pixel(splat, tile, lane, &sums);
            }
            workgroupBarrier();
        }
        if (mine) {
            store_sums(slot, sums, splat.a.z);
        }
    }
    for (var k = stop + thread; k < end; k += BATCH) {
        store_sums(slot_of[k], Sums(vec2<f32>(0.0), 0.0, 0.0, 0.0, 0.0), 0.0);
    }
}

@compute @workgroup_size(64)
fn sum_statistics(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                  @builtin(local_invocation_index) thread: u32) {
    let i = group_of(id, groups) * 64u + thread;
    if (i >= job.count) {
        return;
    }
    var sums: array<f32, STATISTICS>;
    for (var j = 0u; j < STATISTICS; j++) {
        sums[j] = 0.0;
    }
    for (var k = 0u; k < spans[i].x; k++) {
        let at = (spans[i].y + k) * STATISTICS;
        for (var j = 0u; j < 5u; j++) {
            sums[j] += statistic_slots_in[at + j];
        }
        sums[5] = max(sums[5], statistic_slots_in[at + 5u]);
    }
    for (var j = 0u; j < STATISTICS; j++) {
        collected[i * STATISTICS + j] = sums[j];
    }
}

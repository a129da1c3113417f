// composite_backward: the gradient of compositing, again near to far, so that T is not recovered by division.
//
// With g = dL/dimage, gz = dL/ddepth, t = dL/dT_final and R = g . image + gz depth + t T_final at the end, for each splat:
//
//     cg = g . c + gz z;   w = T alpha;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   T -= w
//     h = alpha dL/dalpha, 0 where alpha was clamped
//
// A thread owns a splat of a batch of 64, and T and R of the tile's pixels lie in workgroup memory: at turn i, thread t takes
// pixel i - t, which thread t - 1 left a turn before. Each sum stays in one thread, in the order of the pixels, and goes to
// the pair's own slot: w g (3), w gz, and the moments of h about the splat's reference point.

const SLOT = 10u;

@group(1) @binding(0) var<storage, read> records: array<vec4<f32>>;
@group(1) @binding(1) var<storage, read> owner: array<u32>;
@group(1) @binding(2) var<storage, read> slot_of: array<u32>;
@group(1) @binding(3) var<storage, read> tiles: array<u32>;
@group(1) @binding(4) var<storage, read> done: array<u32>;
@group(1) @binding(5) var<storage, read> image: array<f32>;
@group(1) @binding(6) var<storage, read> grads: array<f32>;       // image 3, transmittance, depth; by pixel
@group(1) @binding(7) var<storage, read_write> slots: array<f32>;

const PIXELS = 256u;

var<workgroup> light: array<vec2<f32>, PIXELS>;                   // T, R
var<workgroup> upstream: array<vec4<f32>, PIXELS>;                // g, gz

struct Sums {
    painted: vec4<f32>,
    h: f32,
    first: vec2<f32>,        // hx, hy
    second: vec3<f32>,       // hxx, hxy, hyy
}

fn load_pixel(tile: u32, lane: u32) {
    let at = pixel_of(tile, lane);
    light[lane] = vec2<f32>(0.0);
    upstream[lane] = vec4<f32>(0.0);
    if (at.x < view.size.x && at.y < view.size.y) {
        let pixel = at.y * view.size.x + at.x;
        let drawn = vec4<f32>(image[6u * pixel], image[6u * pixel + 1u], image[6u * pixel + 2u], image[6u * pixel + 4u]);
        let g = vec4<f32>(grads[5u * pixel], grads[5u * pixel + 1u], grads[5u * pixel + 2u], grads[5u * pixel + 4u]);
        upstream[lane] = g;
        light[lane] = vec2<f32>(1.0, dot(g, drawn) + grads[5u * pixel + 3u] * image[6u * pixel + 3u]);
    }
}

// Takes one splat in one pixel.
fn add_pixel(splat: Splat, tile: u32, lane: u32, sums: ptr<function, Sums>) {
    let d = vec2<f32>(pixel_of(tile, lane)) - splat.a.xy;
    let power = power_at(splat.a, splat.b, d);
    let at = light[lane];
    if (power >= LOG2_ALPHA_MIN && at.x > 0.0) {
        let g = upstream[lane];
        let share = share_of(power, at, g, splat.paint);
        let h = share.h;
        light[lane] = share.left;
        (*sums).painted += share.w * g;
        (*sums).h += h;
        (*sums).first += h * d;
        (*sums).second += h * vec3<f32>(d.x * d.x, d.x * d.y, d.y * d.y);
    }
}

fn store_sums(slot: u32, sums: Sums) {
    let at = slot * SLOT;
    slots[at] = sums.painted.x;
    slots[at + 1u] = sums.painted.y;
    slots[at + 2u] = sums.painted.z;
    slots[at + 3u] = sums.painted.w;
    slots[at + 4u] = sums.h;
    slots[at + 5u] = sums.first.x;
    slots[at + 6u] = sums.first.y;
    slots[at + 7u] = sums.second.x;
    slots[at + 8u] = sums.second.y;
    slots[at + 9u] = sums.second.z;
}

// A workgroup takes a tile; one more than there are tiles clears the slots that belong to none.
@compute @workgroup_size(64)
fn composite_backward(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
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
        var sums = Sums(vec4<f32>(0.0), 0.0, vec2<f32>(0.0), vec3<f32>(0.0));
        for (var turn = 0u; turn < PIXELS + count - 1u; turn++) {
            let lane = turn - thread;          // wraps around to a large number before the thread begins
            if (mine && lane < PIXELS) {
                add_pixel(splat, tile, lane, &sums);
            }
            workgroupBarrier();
        }
        if (mine) {
            store_sums(slot, sums);
        }
    }
    for (var k = stop + thread; k < end; k += BATCH) {
        store_sums(slot_of[k], Sums(vec4<f32>(0.0), 0.0, vec2<f32>(0.0), vec3<f32>(0.0)));
    }
}

// composite: blend a tile's splats into its pixels, near to far; a thread per pixel.
//
//     w = T alpha;   image += w c;   depth += w z;   T -= w
//
// A tile stops once the transmittance of all its pixels is below 1e-4, as in every other renderer here. Each pixel
// notes after how many splats of a batch of 64 its own is. The largest of these numbers is where the tile stops; if that
// is within the batch, the pixels go back to its start and repeat it up to there.
// With the stop per pixel, a pixel ends before the splat that would take its transmittance to 1e-4 or below, and keeps what
// it has; a negative T marks it. Its tile stops once all of its pixels have ended.
// The median depth is that of the splat where T falls below one half, 0 if it never does.

@group(1) @binding(0) var<storage, read> records: array<vec4<f32>>;
@group(1) @binding(1) var<storage, read> owner: array<u32>;
@group(1) @binding(2) var<storage, read> slot_of: array<u32>;
@group(1) @binding(3) var<storage, read> tiles: array<u32>;
@group(1) @binding(4) var<storage, read_write> done: array<u32>;
@group(1) @binding(5) var<storage, read_write> image: array<f32>;

const LIVING = 1000u;        // more than a batch has: the pixel still lets light through

var<workgroup> batch: array<Splat, BATCH>;
var<workgroup> latest: atomic<u32>;
var<workgroup> stop: u32;

struct Pixel {
    mixed: vec4<f32>,        // colour and depth
    T: f32,
    median: f32,
}

fn blended(start: Pixel, pixel: vec2<f32>, count: u32, fell: ptr<function, u32>) -> Pixel {
    var state = start;
    for (var j = 0u; j < count; j++) {
        let a = placed(batch[j].a, u32(pixel.x));
        let power = power_at(a, batch[j].b, pixel - a.xy);
        if (power >= LOG2_ALPHA_MIN && state.T > 0.0) {
            let paint = batch[j].paint;
            let w = state.T * alpha_of(power);
            let after = state.T - w;
            if (after <= view.least_left) {
                state.T = -state.T;
                *fell = j + 1u;
                continue;
            }
            state.mixed += w * paint;
            if (state.T >= 0.5 && after < 0.5) {
                state.median = paint.w;
            }
            if (state.T >= T_STOP && after < T_STOP) {
                *fell = j + 1u;
            }
            state.T = after;
        }
    }
    return state;
}

fn load_splat(pair: u32, lane: u32) {
    let i = owner[slot_of[pair]];
    batch[lane] = Splat(records[4u * i], records[4u * i + 1u], records[4u * i + 2u]);
}

@compute @workgroup_size(256)
fn composite(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) lane: u32) {
    let tile = group_of(id, groups);
    if (tile >= view.tiles) {
        return;
    }
    let at = pixel_of(tile, lane);
    let inside = at.x < view.size.x && at.y < view.size.y;
    let pixel = vec2<f32>(at);
    let begin = tiles[tile];
    let end = tiles[tile + 1u];
    var state = Pixel(vec4<f32>(0.0), select(0.0, 1.0, inside), 0.0);
    var k = begin;
    for (; k < end; k += BATCH) {
        let count = min(BATCH, end - k);
        if (lane < count) {
            load_splat(k + lane, lane);
        }
        if (lane == 0u) {
            atomicStore(&latest, 0u);
        }
        workgroupBarrier();
        var fell = select(0u, LIVING, state.T >= T_STOP);
        let next = blended(state, pixel, count, &fell);
        atomicMax(&latest, fell);          // a maximum of whole numbers has no order
        workgroupBarrier();
        if (lane == 0u) {
            stop = atomicLoad(&latest);
        }
        let last = workgroupUniformLoad(&stop);
        if (last <= count) {
            state = blended(state, pixel, last, &fell);
            k += last;
            break;
        }
        state = next;
    }
    if (lane == 0u) {
        done[tile] = min(k, end) - begin;
    }
    if (inside) {
        let out = 6u * (at.y * view.size.x + at.x);
        let T = abs(state.T);
        let behind = select(view.background, vec3<f32>(0.0), job.shift != 0u);   // features have no background
        let color = state.mixed.xyz + T * behind;
        image[out] = color.x;
        image[out + 1u] = color.y;
        image[out + 2u] = color.z;
        image[out + 3u] = T;
        image[out + 4u] = state.mixed.w;
        image[out + 5u] = state.median;
    }
}

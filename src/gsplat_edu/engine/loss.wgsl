// loss: (1 - k) L1 + k (1 - SSIM) of image and photo, and its gradient.
//
// With G a blur of 11 taps (sigma 1.5, zero outside the image), mx = G x, my = G y, v = G (x² + y²) - mx² - my² (the sum
// of both variances), c = G xy - mx my, all per channel:
//
//     S = A1 A2 / (B1 B2),  A1 = 2 mx my + C1,  A2 = 2 c + C2,  B1 = mx² + my² + C1,  B2 = v + C2
//     dS/dv = -S / B2,  dS/dc = 2 A1 / (B1 B2),  dS/dmx = 2 my A2 / (B1 B2) - 2 mx S / B1 - 2 mx dS/dv - my dS/dc
//     dsum(S)/dx = G dS/dmx + 2 x G dS/dv + y G dS/dc
//
// A workgroup takes a tile with a margin of five pixels, a channel at a time, and blurs it along x, then along y.
// `loss_maps` writes the three maps and the tile's sums of |x - y| and 1 - S, `loss_gradient` blurs the maps. Pixels that
// the mask excludes are black in both. The sums of the tiles are added by `total`, in adam.wgsl.

@group(1) @binding(0) var<storage, read> image: array<f32>;
@group(1) @binding(1) var<storage, read> photo: array<u32>;          // bytes R G B and mask; or three floats and the mask
@group(1) @binding(2) var<storage, read_write> maps: array<f32>;     // 9 a pixel: three for each channel
@group(1) @binding(3) var<storage, read_write> loss_sums: array<vec2<f32>>;

@group(1) @binding(2) var<storage, read> maps_in: array<f32>;
@group(1) @binding(3) var<storage, read_write> grads: array<f32>;    // image 3, transmittance, depth

const HALF = 5;
const SIDE = 16u;
const WIDE = 26u;            // SIDE + 2 HALF
const FIELD = 676u;          // WIDE x WIDE
const ROWS = 416u;           // WIDE x SIDE

var<workgroup> field: array<f32, 2028>;      // 3 x FIELD
var<workgroup> across: array<f32, 1664>;     // 4 x ROWS

fn tap(k: u32) -> f32 {
    return SSIM_TAP[u32(abs(i32(k) - HALF))];
}

struct Pair {
    x: f32,
    y: f32,
    counts: bool,
}

fn pair_at(pixel: u32, channel: u32) -> Pair {
    let x = image[6u * pixel + channel];
    if (view.numbers[RULES].z == 0u) {
        let word = photo[pixel];
        let counts = (word >> 24u) != 0u;
        return Pair(select(0.0, x, counts), select(0.0, f32((word >> (8u * channel)) & 255u) / 255.0, counts), counts);
    }
    let counts = photo[4u * pixel + 3u] != 0u;
    return Pair(select(0.0, x, counts), select(0.0, bitcast<f32>(photo[4u * pixel + channel]), counts), counts);
}

// The pixel of an entry of the field, and whether it is in the image.
fn field_pixel(tile: u32, k: u32) -> vec3<u32> {
    let corner = vec2<i32>(vec2<u32>(tile % view.tiles_x, tile / view.tiles_x) * SIDE) - HALF;
    let at = corner + vec2<i32>(vec2<u32>(k % WIDE, k / WIDE));
    let inside = all(at >= vec2<i32>(0)) && all(at < vec2<i32>(view.size));
    return vec3<u32>(vec2<u32>(select(vec2<i32>(0), at, inside)), select(0u, 1u, inside));
}

fn load_pairs(tile: u32, channel: u32, lane: u32) {
    for (var k = lane; k < FIELD; k += 256u) {
        let at = field_pixel(tile, k);
        let pair = pair_at(at.y * view.size.x + at.x, channel);
        field[k] = select(0.0, pair.x, at.z != 0u);
        field[FIELD + k] = select(0.0, pair.y, at.z != 0u);
    }
}

fn blur_pairs_across(lane: u32) {
    for (var k = lane; k < ROWS; k += 256u) {
        let from_ = k / SIDE * WIDE + k % SIDE;
        var sums = vec4<f32>(0.0);
        for (var j = 0u; j < 11u; j++) {
            let x = field[from_ + j];
            let y = field[FIELD + from_ + j];
            sums += tap(j) * vec4<f32>(x, y, x * x + y * y, x * y);
        }
        across[k] = sums.x;
        across[ROWS + k] = sums.y;
        across[2u * ROWS + k] = sums.z;
        across[3u * ROWS + k] = sums.w;
    }
}

fn blurred_down(map: u32, lane: u32) -> f32 {
    var sum = 0.0;
    for (var j = 0u; j < 11u; j++) {
        sum += tap(j) * across[map * ROWS + lane + j * SIDE];
    }
    return sum;
}

// Returns 1 - S, and writes the maps.
fn dissimilarity(place: u32, inside: bool, lane: u32) -> f32 {
    let mx = blurred_down(0u, lane);
    let my = blurred_down(1u, lane);
    let v = blurred_down(2u, lane) - mx * mx - my * my;
    let c = blurred_down(3u, lane) - mx * my;
    let A1 = 2.0 * mx * my + SSIM_C1;
    let A2 = 2.0 * c + SSIM_C2;
    let B1 = mx * mx + my * my + SSIM_C1;
    let B2 = v + SSIM_C2;
    let inverse = 1.0 / (B1 * B2);
    let S = A1 * A2 * inverse;
    let dv = -S * B1 * inverse;
    let dc = 2.0 * A1 * inverse;
    if (inside) {
        maps[place] = 2.0 * inverse * (my * A2 - mx * S * B2) - 2.0 * mx * dv - my * dc;
        maps[place + 1u] = dv;
        maps[place + 2u] = dc;
    }
    return select(0.0, 1.0 - S, inside);
}

@compute @workgroup_size(256)
fn loss_maps(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) lane: u32) {
    let tile = group_of(id, groups);
    if (tile >= job.count) {
        return;
    }
    if (tile >= view.tiles) {
        if (lane == 0u) {
            loss_sums[tile] = vec2<f32>(0.0);
        }
        return;
    }
    let at = vec2<u32>(tile % view.tiles_x, tile / view.tiles_x) * SIDE + vec2<u32>(lane % SIDE, lane / SIDE);
    let inside = at.x < view.size.x && at.y < view.size.y;
    let pixel = at.y * view.size.x + at.x;
    let middle = (lane / SIDE + u32(HALF)) * WIDE + lane % SIDE + u32(HALF);
    var sums = vec2<f32>(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        load_pairs(tile, channel, lane);
        workgroupBarrier();
        sums.x += abs(field[middle] - field[FIELD + middle]);
        blur_pairs_across(lane);
        workgroupBarrier();
        sums.y += dissimilarity(9u * pixel + 3u * channel, inside, lane);
    }
    workgroupBarrier();
    field[lane] = sums.x;                // outside the image both are 0
    field[256u + lane] = sums.y;
    workgroupBarrier();
    for (var reach = 128u; reach > 0u; reach /= 2u) {
        if (lane < reach) {
            field[lane] += field[lane + reach];
            field[256u + lane] += field[256u + lane + reach];
        }
        workgroupBarrier();
    }
    if (lane == 0u) {
        loss_sums[tile] = vec2<f32>(field[0], field[256]);
    }
}

fn load_maps(tile: u32, channel: u32, lane: u32) {
    for (var k = lane; k < FIELD; k += 256u) {
        let at = field_pixel(tile, k);
        let place = 9u * (at.y * view.size.x + at.x) + 3u * channel;
        for (var map = 0u; map < 3u; map++) {
            field[map * FIELD + k] = select(0.0, maps_in[place + map], at.z != 0u);
        }
    }
}

fn blur_maps_across(lane: u32) {
    for (var k = lane; k < ROWS; k += 256u) {
        let from_ = k / SIDE * WIDE + k % SIDE;
        var sums = vec3<f32>(0.0);
        for (var j = 0u; j < 11u; j++) {
            sums += tap(j) * vec3<f32>(field[from_ + j], field[FIELD + from_ + j], field[2u * FIELD + from_ + j]);
        }
        across[k] = sums.x;
        across[ROWS + k] = sums.y;
        across[2u * ROWS + k] = sums.z;
    }
}

@compute @workgroup_size(256)
fn loss_gradient(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                 @builtin(local_invocation_index) lane: u32) {
    let tile = group_of(id, groups);
    if (tile >= view.tiles) {
        return;
    }
    let at = vec2<u32>(tile % view.tiles_x, tile / view.tiles_x) * SIDE + vec2<u32>(lane % SIDE, lane / SIDE);
    let inside = at.x < view.size.x && at.y < view.size.y;
    let pixel = select(0u, at.y * view.size.x + at.x, inside);
    let weights = floats_at(WEIGHTS);
    for (var channel = 0u; channel < 3u; channel++) {
        load_maps(tile, channel, lane);
        workgroupBarrier();
        blur_maps_across(lane);
        workgroupBarrier();
        if (inside) {
            let pair = pair_at(pixel, channel);
            let up = blurred_down(0u, lane) + 2.0 * pair.x * blurred_down(1u, lane) + pair.y * blurred_down(2u, lane);
            grads[5u * pixel + channel] = select(0.0, weights.x * sign(pair.x - pair.y) - weights.y * up, pair.counts);
        }
    }
    if (inside) {
        grads[5u * pixel + 3u] = 0.0;
        grads[5u * pixel + 4u] = 0.0;
    }
}

// A splat in a pixel, in both directions of compositing.
//
//     p = log2 o - s² - t²;   alpha = min(alpha_max, 2^p), 0 where p < log2(1/255)

const BATCH = 64u;

struct Splat {
    a: vec4<f32>,            // x, y, sx, sy
    b: vec4<f32>,            // ty, s0, t0, log2 o
    paint: vec4<f32>,        // colour and depth, or four features
}

fn power_at(a: vec4<f32>, b: vec4<f32>, d: vec2<f32>) -> f32 {
    let s = b.y + a.z * d.x + a.w * d.y;
    let t = b.z + b.x * d.y;
    return b.w - s * s - t * t;
}

// Of a splat that is drawn, power >= LOG2_ALPHA_MIN.
fn alpha_of(power: f32) -> f32 {
    return min(exp2(min(power, 0.0)), view.alpha_max);
}

fn pixel_of(tile: u32, lane: u32) -> vec2<u32> {
    let size = u32(TILE);
    return vec2<u32>(tile % view.tiles_x, tile / view.tiles_x) * size + vec2<u32>(lane % size, lane / size);
}

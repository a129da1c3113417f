// A splat in a pixel, in both directions of compositing.
//
//     p = log2 o - s² - t²;   alpha = min(alpha_max, 2^p), 0 where p < log2(1/255)

const BATCH = 64u;

struct Splat {
    a: vec4<f32>,            // x, y, sx, sy
    b: vec4<f32>,            // ty, s0, t0, log2 o
    paint: vec4<f32>,        // colour and depth, or four features
}

fn power_at(splat: Splat, d: vec2<f32>) -> f32 {
    let s = splat.b.y + splat.a.z * d.x + splat.a.w * d.y;
    let t = splat.b.z + splat.b.x * d.y;
    return splat.b.w - s * s - t * t;
}

fn alpha_of(power: f32) -> f32 {
    return select(0.0, min(exp2(min(power, 0.0)), view.alpha_max), power >= LOG2_ALPHA_MIN);
}

fn pixel_of(tile: u32, lane: u32) -> vec2<u32> {
    let size = u32(TILE);
    return vec2<u32>(tile % view.tiles_x, tile / view.tiles_x) * size + vec2<u32>(lane % size, lane / size);
}

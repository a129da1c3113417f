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

// The first row of a record, moved to where the tile of a column sees it.
fn placed(a: vec4<f32>, column: u32) -> vec4<f32> {
    if (COPIES == 1) {
        return a;
    }
    return vec4<f32>(a.x + seam_shift(column, a.x), a.yzw);
}

// Of a splat that is drawn, power >= LOG2_ALPHA_MIN.
fn alpha_of(power: f32) -> f32 {
    return min(exp2(min(power, 0.0)), view.alpha_max);
}

fn pixel_of(tile: u32, lane: u32) -> vec2<u32> {
    let size = u32(TILE);
    return vec2<u32>(tile % view.tiles_x, tile / view.tiles_x) * size + vec2<u32>(lane % size, lane / size);
}

// What a splat takes from a pixel in the backward pass, and what it leaves: see composite_backward.wgsl.
struct Share {
    w: f32,
    h: f32,
    left: vec2<f32>,         // T, R; T is negative in a pixel that has ended
}

// Of a splat that is drawn in a pixel with T and R `at`, and gradient `g` of colour and depth.
fn share_of(power: f32, at: vec2<f32>, g: vec4<f32>, paint: vec4<f32>) -> Share {
    let alpha = alpha_of(power);
    let w = at.x * alpha;
    let after = at.x - w;
    if (after <= view.least_left) {
        return Share(0.0, 0.0, vec2<f32>(-at.x, at.y));
    }
    let drawn = w * dot(g, paint);
    let left = at.y - drawn;
    let h = select(drawn - left * (alpha / (1.0 - alpha)), 0.0, power >= view.log2_alpha_max);
    return Share(w, h, vec2<f32>(after, left));
}

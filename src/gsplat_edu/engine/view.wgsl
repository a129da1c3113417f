// The camera and the settings of a render, the same for all of its passes.

struct View {
    R0: vec4<f32>,           // rows of R: x_cam = R (x - eye)
    R1: vec4<f32>,
    R2: vec4<f32>,
    eye: vec4<f32>,          // rounded to f32
    eye_rest: vec4<f32>,     // what the rounding left
    focal: vec2<f32>,        // fx, fy, px
    middle: vec2<f32>,       // cx, cy, px
    low: vec2<f32>,          // bounds of x/z and y/z inside the Jacobian
    high: vec2<f32>,
    background: vec3<f32>,
    least_left: f32,         // a pixel ends before the splat that would leave it this transmittance or less; -1: it never does
    z_near: f32,
    dilation: f32,           // px²
    alpha_max: f32,
    log2_alpha_max: f32,
    size: vec2<u32>,         // W, H, px
    tiles_x: u32,
    tiles: u32,
    degree: u32,             // of the harmonics that are used
    rest: u32,               // harmonics per Gaussian in `rest`
    antialiased: u32,
    zero: u32,               // 0, but the compiler does not know
    numbers: array<vec4<u32>, 20>,   // of a step of training: see step.wgsl
    lens: array<vec4<u32>, 8>,       // of any camera but a pinhole at rest: see lens.wgsl
}

@group(0) @binding(1) var<uniform> view: View;

// The same number, which the compiler cannot reorder with what follows: WGSL lets it treat sums as real ones.
fn kept(x: f32) -> f32 {
    return bitcast<f32>(bitcast<u32>(x) ^ view.zero);
}

fn kept3(x: vec3<f32>) -> vec3<f32> {
    return bitcast<vec3<f32>>(bitcast<vec3<u32>>(x) ^ vec3<u32>(view.zero));
}

// WGSL lets a compiler assume that NaN and infinity do not occur, so `x == x` proves nothing. Their exponents do.
fn finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn finite3(x: vec3<f32>) -> bool {
    return finite(x.x) && finite(x.y) && finite(x.z);
}

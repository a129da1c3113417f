// The numbers of a step of training, in `view.numbers`; `step.py` packs them.

const MEANS = 0u;            // Adam's groups
const QUATS = 1u;
const SCALES = 2u;
const COLORS = 3u;
const LOGITS = 4u;
const HARMONICS = 5u;

const WEIGHTS = 12u;         // (1 - k) / 3HW, k / 3HW, weight of the opacities, of the scales / 3N
const SHELL = 13u;           // centre, and the squared distance beyond which a splat is far; negative for none
const RULES = 14u;           // count of the visible below which they alone are averaged, whether to collect statistics,
                             // whether the photo has floats, Gaussians
const NOISE = 15u;           // amount, sharpness, threshold, 0
const SEED = 16u;            // low and high word

// Words of `live` beyond those of a render.
const VISIBLE = 0u;
const HALT = 3u;             // set by a step without room for its pairs: it and those after it change nothing

struct Rates {
    rate: f32,
    b1: f32,
    new1: f32,               // 1 - b1
    b2: f32,
    new2: f32,               // 1 - b2
    eps: f32,
    correction1: f32,        // 1 - b1^t
    correction2: f32,
}

fn rates_of(group: u32) -> Rates {
    let a = bitcast<vec4<f32>>(view.numbers[2u * group]);
    let b = bitcast<vec4<f32>>(view.numbers[2u * group + 1u]);
    return Rates(a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w);
}

fn floats_at(row: u32) -> vec4<f32> {
    return bitcast<vec4<f32>>(view.numbers[row]);
}

fn is_far(mean: vec3<f32>) -> bool {
    let shell = floats_at(SHELL);
    let away = mean - shell.xyz;
    return shell.w >= 0.0 && dot(away, away) > shell.w;
}

// Functions whose digits matter: built-in ones may be off by many units in the last place.

const LN2_HIGH = 0.693145751953125;      // its 16 bits times a whole number below 256 are exact
const LN2_LOW = 1.42860677e-6;
const SCALE_MOST = 80.0;     // natural logarithm; exp(80) squared overflows

// e^x for |x| up to 80 within about 2 ULP; the built-in may err by 3 + 2 |x|.
fn exp_exact(x: f32) -> f32 {
    let k = round(x * 1.44269504);
    let r = kept(x - k * LN2_HIGH) - k * LN2_LOW;
    let tail = 0.0416666667 + r * (0.00833333333 + r * (0.00138888889 + r * 0.000198412698));
    let p = 1.0 + r * (1.0 + r * (0.5 + r * (0.166666667 + r * tail)));
    let half = i32(k) / 2;                // in two factors: 2^k may leave the range of a float
    let other = i32(k) - half;
    return p * bitcast<f32>(u32(half + 127) << 23u) * bitcast<f32>(u32(other + 127) << 23u);
}

// log x of a positive, normal number, also near 1, where the built-in may be off by 2^-21.
//
//     log m = 2 (t + t³/3 + t⁵/5 + ...),  t = (m - 1) / (m + 1),  sqrt(1/2) <= m < sqrt(2)
fn log_exact(x: f32) -> f32 {
    let bits = bitcast<u32>(x);
    let whole = i32((bits + 0x004afb0du) >> 23u) - 127;      // the nearest power of 2 in the logarithm
    let m = bitcast<f32>(bits - (u32(whole) << 23u));
    let t = (m - 1.0) / (m + 1.0);
    let q = t * t;
    let tail = q * (0.333333333 + q * (0.2 + q * (0.142857143 + q * (0.111111111 + q * 0.0909090909))));
    return f32(whole) * LN2_HIGH + (f32(whole) * LN2_LOW + 2.0 * (t + t * tail));
}

// (cos, sin) of 2 pi v, 0 <= v < 1, a whole number of 2^-24.
fn turned(v: f32) -> vec2<f32> {
    let quarters = round(4.0 * v);
    let x = (4.0 * v - quarters) * 1.57079633;               // the difference is exact; |x| <= pi / 4
    let q = x * x;
    let s = x * (1.0 - q * (0.166666667 - q * (0.00833333333 - q * (0.000198412698 - q * 0.00000275573192))));
    let c = 1.0 - q * (0.5 - q * (0.0416666667 - q * (0.00138888889 - q * (0.0000248015873 - q * 0.000000275573192))));
    switch (u32(quarters) & 3u) {
        case 1u: { return vec2<f32>(-s, c); }
        case 2u: { return vec2<f32>(-c, -s); }
        case 3u: { return vec2<f32>(s, -c); }
        default: { return vec2<f32>(c, s); }
    }
}

// R(q) of a unit quaternion.
fn rotation(q: vec4<f32>) -> mat3x3<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3<f32>(
        vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3<f32>(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3<f32>(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}

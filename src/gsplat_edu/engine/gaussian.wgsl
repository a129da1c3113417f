// A Gaussian on the screen, from its raw parameters; project and project_backward both begin here.
//
//     Sigma2d = J W Sigma W' J' + d I + g g', d: dilation, g: motion blur
//
// `project_mean` is that of pinhole.wgsl or of sight.wgsl. Names are those of native/gaussian_math.h.

const CORE = 14u;            // mean 3, quaternion 4, log scales 3, sh0 3, logit 1

@group(1) @binding(0) var<storage, read> core: array<f32>;
@group(1) @binding(1) var<storage, read> rest: array<f32>;

struct Projected {
    offset: vec3<f32>,       // mean - eye, world axes
    p: vec3<f32>,            // mean in camera axes
    ratio: vec2<f32>,        // x/z and y/z, clamped for the Jacobian
    clamped: vec2<bool>,
    t0: vec3<f32>,           // rows of J W
    t1: vec3<f32>,
    q: vec4<f32>,            // unit quaternion w x y z
    q_length: f32,
    R: mat3x3<f32>,          // columns are the Gaussian's axes
    s: vec3<f32>,            // scales
    r0: vec3<f32>,           // rows of J W M, M = R S, and their cross product
    r1: vec3<f32>,
    n: vec3<f32>,
    blur: vec2<f32>,         // g, px; 0 without an exposure
    blurred: bool,           // whether the camera has an exposure
    still: f32,              // determinant after the dilation, before the blur
    a: f32,                  // dilated and blurred covariance
    b: f32,
    c: f32,
    det0: f32,               // determinant before dilation
    det: f32,
    opacity: f32,            // before the factor of antialiasing and blur
    transparency: f32,       // 1 - opacity
    compensation: f32,
    uv: vec2<f32>,
    nearest: vec2<f32>,      // point of the image nearest to the mean: the reference of s and t
    valid: bool,
}

fn core3(at: u32) -> vec3<f32> {
    return vec3<f32>(core[at], core[at + 1u], core[at + 2u]);
}

fn project_covariance(i: u32, g: ptr<function, Projected>) {
    let raw = vec4<f32>(core[i * CORE + 3u], core[i * CORE + 4u], core[i * CORE + 5u], core[i * CORE + 6u]);
    // Dividing by the largest entry first keeps the length from overflowing and underflowing.
    let largest = max(max(abs(raw.x), abs(raw.y)), max(abs(raw.z), abs(raw.w)));
    let fits = finite(raw.x) && finite(raw.y) && finite(raw.z) && finite(raw.w) && largest > 0.0;
    let even = raw / select(1.0, largest, fits);
    let size = select(1.0, sqrt(dot(even, even)), fits);
    (*g).q = even / size;
    (*g).q_length = largest * size;
    (*g).R = rotation((*g).q);
    let logs = core3(i * CORE + 7u);
    let bits = bitcast<vec3<u32>>(logs) & vec3<u32>(0x7fffffffu);
    let numbers = all(bits <= vec3<u32>(0x7f800000u));       // minus infinity is a scale of 0
    (*g).valid = (*g).valid && fits && numbers && all(logs <= vec3<f32>(SCALE_MOST)) && finite((*g).q_length);
    let low = clamp(logs, vec3<f32>(-SCALE_MOST), vec3<f32>(SCALE_MOST));
    (*g).s = vec3<f32>(exp_exact(low.x), exp_exact(low.y), exp_exact(low.z));
    (*g).r0 = ((*g).t0 * (*g).R) * (*g).s;                   // a row times a matrix
    (*g).r1 = ((*g).t1 * (*g).R) * (*g).s;
    // |n|² = a0 c0 - b0² without cancellation. n is not computed from r0 and r1, which are almost parallel for a needle.
    (*g).n = (*g).s.yzx * (*g).s.zxy * (cross((*g).t0, (*g).t1) * (*g).R);
}

// Returns the Gaussian; `valid` is false if it is not drawn, and then no other number counts.
fn project_shape(i: u32) -> Projected {
    var g: Projected;
    project_mean(i, &g);
    project_covariance(i, &g);
    let d = view.dilation;
    let a0 = dot(g.r0, g.r0);
    let c0 = dot(g.r1, g.r1);
    g.b = dot(g.r0, g.r1);
    g.a = a0 + d;
    g.c = c0 + d;
    g.det0 = dot(g.n, g.n);
    g.det = g.det0 + d * (a0 + c0) + d * d;
    let logit = core[i * CORE + 13u];
    let number = (bitcast<u32>(logit) & 0x7fffffffu) <= 0x7f800000u;
    let falling = exp_exact(clamp(-logit, -SCALE_MOST, SCALE_MOST));
    g.opacity = 1.0 / (1.0 + falling);
    g.transparency = falling / (1.0 + falling);
    g.still = g.det;
    g.compensation = 1.0;
    if (g.blurred) {                             // no term of the determinants' difference is negative
        let along = g.blur.x * g.r1 - g.blur.y * g.r0;
        g.det += dot(along, along) + d * dot(g.blur, g.blur);
        g.a += g.blur.x * g.blur.x;
        g.b += g.blur.x * g.blur.y;
        g.c += g.blur.y * g.blur.y;
        g.compensation = sqrt(g.still / g.det);
    }
    if (view.antialiased != 0u) {
        g.compensation = sqrt(max(g.det0, DET_FLOOR) / g.det);
    }
    g.valid = g.valid && number && finite(g.a + g.c) && g.a + g.c <= SPLAT_LIMIT_F32 * SPLAT_LIMIT_F32 && finite(g.det)
        && g.det > THINNEST * (g.a + g.c) && g.opacity * g.compensation >= ALPHA_MIN;
    return g;
}

// Factors of the exponent without log2(e)/2: s = sx dx + sy dy, t = ty dy, d' Sigma2d^-1 d = s² + t².
fn whitening(g: Projected) -> vec3<f32> {
    let sx = sqrt(g.c / g.det);
    return vec3<f32>(sx, -g.b / g.c * sx, sqrt(1.0 / g.c));
}

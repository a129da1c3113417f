// Projections other than the pinhole: place on the plane, and Jacobian.
//
//     (u, v) = f D(C(p)) + c,   C: core (perspective, fisheye, equirectangular, orthographic),   D: distortion
//
// Formulas and names are those of native/lens.h. The lens lies in `view.lens`; `view.py` packs it.

const PERSPECTIVE = 0u;      // in the order of KINDS in src/gsplat_edu/scene/projection.py
const FISHEYE = 1u;
const EQUIRECTANGULAR = 2u;
const ORTHOGRAPHIC = 3u;

const WIDEST = 3u;           // rows of `view.lens`; 0 to 3 have the fifteen coefficients, then the widest angle's cos or tan²
const TURN = 4u;             // w, and the pace of the readout, 1/px
const SHIFT = 5u;            // V, and the middle of the readout, px
const KIND = 6u;             // kind, whether there are coefficients, whether radial ones come first, whether it moves
const AXIS = 7u;             // readout's axis, whether depth is the distance, whether the ellipse has bounds; exposure / sqrt(12)

const PI = 3.14159265;
const POLAR = 1e-12;         // at less than this h² / |p|², rounding leaves no longitude
const TINY = 1e-18;          // stands for a z of 0

fn lens_row(row: u32) -> vec4<f32> {
    return bitcast<vec4<f32>>(view.lens[row]);
}

fn coefficient(k: u32) -> f32 {
    return bitcast<f32>(view.lens[k / 4u][k % 4u]);
}

// atan(t) / t for t² <= 0.172, by q = t²: the first term that is left out is 7e-9.
fn arc_tangent(q: f32) -> f32 {
    let tail = 0.111111111 - q * (0.0909090909 - q * (0.0769230769 - q * (0.0666666667 - q * 0.0588235294)));
    return 1.0 - q * (0.333333333 - q * (0.2 - q * (0.142857143 - q * tail)));
}

// atan2(y, x) for y >= 0, in [0, pi], within about 3 ULP; the built-in may err by 4096. Between tan(pi / 8) and its inverse,
// the angle to pi / 4 is small.
fn angle_of(y: f32, x: f32) -> f32 {
    let across = abs(x);
    let low = min(y, across);
    let high = max(max(y, across), 1e-37);
    let diagonal = low > 0.414213562 * high;
    let t = select(low, low - high, diagonal) / select(high, low + high, diagonal);
    var angle = t * arc_tangent(t * t) + select(0.0, 0.25 * PI, diagonal);
    angle = select(angle, 0.5 * PI - angle, y > across);
    return select(angle, PI - angle, x < 0.0);
}

// atan2(y, x) in (-pi, pi].
fn signed_angle(y: f32, x: f32) -> f32 {
    let angle = angle_of(abs(y), x);
    return select(angle, -angle, y < 0.0);
}

struct OnPlane {
    place: vec2<f32>,
    J0: vec3<f32>,           // rows of the Jacobian
    J1: vec3<f32>,
    ellipse: vec3<f32>,      // the first row with the bound at the poles; otherwise the first row
}

// theta / r, and its derivatives by s = r² and z.
struct Arc {
    A: f32,
    s1: f32,
    z1: f32,
    s2: f32,
    sz: f32,
    z2: f32,
}

// Near the axis, the closed forms cancel: with t = s / z², the relative error of s1 grows as eps / t, and that of s2 as eps / t².
// Up to t = 0.1, a series takes their place. What it leaves out is largest in the second derivative, 10 x 9 t⁸ / 21 = 4e-8 of 0.33.
// Right beyond 0.1, the closed form of s1 errs by 31 eps, and that of s s2 by 50 eps of s1 (200,000 random points); both fall from there.
fn arc_of(s: f32, z: f32) -> Arc {
    let near = z > 0.0 && s < NEAR_AXIS_F32 * z * z;
    let inverse = 1.0 / max(s + z * z, 1e-37);
    var arc: Arc;
    if (near) {
        let iz = 1.0 / z;
        let iz2 = iz * iz;
        let t = s * iz2;
        var value = 0.0;
        var slope = 0.0;
        var curve = 0.0;
        for (var n = 9; n >= 0; n--) {
            curve = curve * t + 2.0 * slope;
            slope = slope * t + value;
            value = value * t + select(1.0, -1.0, (n & 1) == 1) / f32(2 * n + 1);
        }
        arc.A = value * iz;
        arc.s1 = slope * iz2 * iz;
        arc.s2 = curve * iz2 * iz2 * iz;
    } else {
        let away = max(s, 1e-37);
        let r = sqrt(away);
        let twice = 0.5 / away;
        arc.A = angle_of(r, z) / r;
        arc.s1 = (z * inverse - arc.A) * twice;
        arc.s2 = -(z * inverse * inverse + 3.0 * arc.s1) * twice;
    }
    arc.z1 = -inverse;
    arc.sz = inverse * inverse;
    arc.z2 = 2.0 * z * arc.sz;
    return arc;
}

fn not_zero(z: f32) -> f32 {
    return select(z, TINY, abs(z) < TINY);
}

fn core_of(p: vec3<f32>) -> OnPlane {
    var on: OnPlane;
    switch (view.lens[KIND].x) {
        case PERSPECTIVE: {
            let iz = 1.0 / not_zero(p.z);
            on.place = p.xy * iz;
            on.J0 = vec3<f32>(iz, 0.0, -on.place.x * iz);
            on.J1 = vec3<f32>(0.0, iz, -on.place.y * iz);
            on.ellipse = on.J0;
        }
        case FISHEYE: {
            let arc = arc_of(dot(p.xy, p.xy), p.z);
            let mixed = 2.0 * arc.s1 * p.x * p.y;
            on.place = p.xy * arc.A;
            on.J0 = vec3<f32>(arc.A + 2.0 * arc.s1 * p.x * p.x, mixed, p.x * arc.z1);
            on.J1 = vec3<f32>(mixed, arc.A + 2.0 * arc.s1 * p.y * p.y, p.y * arc.z1);
            on.ellipse = on.J0;
        }
        case EQUIRECTANGULAR: {
            let h2 = max(p.x * p.x + p.z * p.z, 1e-37);
            let p2 = h2 + p.y * p.y;
            let h = sqrt(h2);
            let down = p.y / (p2 * h);
            let level = vec3<f32>(p.z, 0.0, -p.x);
            on.place = vec2<f32>(signed_angle(p.x, p.z), signed_angle(p.y, h));
            on.J0 = level / h2;
            on.ellipse = level / (h * max(h, POLE * sqrt(p2)));
            on.J1 = vec3<f32>(-p.x * down, h / p2, -p.z * down);
        }
        default: {
            on.place = p.xy;
            on.J0 = vec3<f32>(1.0, 0.0, 0.0);
            on.J1 = vec3<f32>(0.0, 1.0, 0.0);
            on.ellipse = on.J0;
        }
    }
    return on;
}

// R(q) = N / D of a distortion, and its derivatives.
struct Radial {
    R: f32,
    first: f32,
    second: f32,
    inverse: f32,            // 1 / D
    below1: f32,             // D'
}

fn radial_of(q: f32) -> Radial {
    var N = vec3<f32>(0.0);  // value, first and second derivative
    var D = vec3<f32>(0.0);
    for (var i = 6; i > 0; i--) {
        N = N * q + vec3<f32>(coefficient(u32(i - 1)), N.x, 2.0 * N.y);
    }
    N = N * q + vec3<f32>(1.0, N.x, 2.0 * N.y);
    for (var i = 9; i > 6; i--) {
        D = D * q + vec3<f32>(coefficient(u32(i - 1)), D.x, 2.0 * D.y);
    }
    D = D * q + vec3<f32>(1.0, D.x, 2.0 * D.y);
    var r: Radial;
    r.inverse = 1.0 / not_zero(D.x);
    r.below1 = D.y;
    r.R = N.x * r.inverse;
    r.first = (N.y - r.R * D.y) * r.inverse;
    r.second = (N.z - r.R * D.z - 2.0 * r.first * D.y) * r.inverse;
    return r;
}

// A shift of places, and the rows of its Jacobian; or a distorted place.
struct Moved {
    m: vec2<f32>,
    K0: vec2<f32>,
    K1: vec2<f32>,
}

// Decentring and prism at `at`.
fn decentred_of(at: vec2<f32>) -> Moved {
    let p = vec2<f32>(coefficient(9u), coefficient(10u));
    let even = vec2<f32>(coefficient(11u), coefficient(13u));      // s1, s3
    let steep = vec2<f32>(coefficient(12u), coefficient(14u));     // s2, s4
    let Q = dot(at, at);
    let cross = 2.0 * at.x * at.y;
    let grow = 2.0 * (even + 2.0 * steep * Q);
    let mixed = 2.0 * dot(p, at);
    var d: Moved;
    d.m = p.xy * cross + p.yx * (vec2<f32>(Q) + 2.0 * at * at) + Q * (even + steep * Q);
    d.K0 = vec2<f32>(2.0 * p.x * at.y + 6.0 * p.y * at.x + grow.x * at.x, mixed + grow.x * at.y);
    d.K1 = vec2<f32>(mixed + grow.y * at.x, 6.0 * p.x * at.y + 2.0 * p.y * at.x + grow.y * at.y);
    return d;
}

// The Jacobian of R a; it is symmetric. Its diagonal, and the other entry.
fn radial_slope(r: Radial, a: vec2<f32>) -> vec3<f32> {
    return vec3<f32>(r.R + 2.0 * r.first * a.x * a.x, r.R + 2.0 * r.first * a.y * a.y, 2.0 * r.first * a.x * a.y);
}

fn distorted(a: vec2<f32>) -> Moved {
    let r = radial_of(dot(a, a));
    let k = radial_slope(r, a);
    let row0 = k.xz;
    let row1 = k.zy;
    var to: Moved;
    if (view.lens[KIND].z != 0u) {
        let d = decentred_of(r.R * a);
        to.m = r.R * a + d.m;
        to.K0 = row0 + d.K0.x * row0 + d.K0.y * row1;
        to.K1 = row1 + d.K1.x * row0 + d.K1.y * row1;
    } else {
        let d = decentred_of(a);
        to.m = r.R * a + d.m;
        to.K0 = row0 + d.K0;
        to.K1 = row1 + d.K1;
    }
    return to;
}

// The image point of p, and two Jacobians by camera axes, px: the true one, and that of the ellipse, whose first row differs near the
// poles of a panorama; its second row is J1.
struct Image {
    at: vec2<f32>,
    J0: vec3<f32>,
    J1: vec3<f32>,
    ellipse: vec3<f32>,
}

fn image_of(p: vec3<f32>) -> Image {
    let on = core_of(p);
    let f = view.focal;
    if (view.lens[KIND].y == 0u) {
        return Image(f * on.place + view.middle, f.x * on.J0, f.y * on.J1, f.x * on.ellipse);
    }
    let to = distorted(on.place);
    let row0 = f.x * (to.K0.x * on.J0 + to.K0.y * on.J1);
    let row1 = f.y * (to.K1.x * on.J0 + to.K1.y * on.J1);
    return Image(f * to.m + view.middle, row0, row1, row0);
}

// The point at which the ellipse of a perspective lens takes its Jacobian: x/z and y/z of p are moved into the view's bounds.
fn clamped_point(p: vec3<f32>) -> vec3<f32> {
    if (view.lens[AXIS].z == 0u) {
        return p;
    }
    let low = view.low * p.z;
    let high = view.high * p.z;
    return vec3<f32>(select(select(p.xy, high, p.xy > high), low, p.xy < low), p.z);
}

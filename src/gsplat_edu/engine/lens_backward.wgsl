// The adjoint of lens.wgsl: from an image point and its Jacobians to the point p, and to the lens.
//
// A cotangent of a Jacobian needs second derivatives. G0 and G1 are the rows of one.

// Cotangents of an `Image`, and of `ellipse` also in the second row.
struct ImageGradient {
    at: vec2<f32>,
    J0: vec3<f32>,
    J1: vec3<f32>,
    e0: vec3<f32>,
    e1: vec3<f32>,
}

// What the core's Jacobian passes on to p; `bounded`: the cotangent of the row `ellipse` of a panorama.
fn core_curvature(p: vec3<f32>, G0: vec3<f32>, G1: vec3<f32>, bounded: vec3<f32>) -> vec3<f32> {
    switch (view.lens[KIND].x) {
        case PERSPECTIVE: {
            let iz = 1.0 / not_zero(p.z);
            let deep = 2.0 * iz * (p.x * G0.z + p.y * G1.z) - G0.x - G1.y;
            return iz * iz * vec3<f32>(-G0.z, -G1.z, deep);
        }
        case FISHEYE: {
            return fisheye_curvature(p, G0, G1);
        }
        case EQUIRECTANGULAR: {
            return longitude_curvature(p, G0, bounded) + latitude_curvature(p, G1);
        }
        default: {
            return vec3<f32>(0.0);
        }
    }
}

fn fisheye_curvature(p: vec3<f32>, G0: vec3<f32>, G1: vec3<f32>) -> vec3<f32> {
    let arc = arc_of(dot(p.xy, p.xy), p.z);
    let mixed = G0.y + G1.x;
    let trace = G0.x + G1.y;
    let by_s = 2.0 * (p.x * p.x * G0.x + p.x * p.y * mixed + p.y * p.y * G1.y);
    let by_z = p.x * G0.z + p.y * G1.z;
    let e = 2.0 * (trace * arc.s1 + by_s * arc.s2 + by_z * arc.sz);
    return vec3<f32>(
        arc.s1 * (4.0 * p.x * G0.x + 2.0 * p.y * mixed) + arc.z1 * G0.z + p.x * e,
        arc.s1 * (4.0 * p.y * G1.y + 2.0 * p.x * mixed) + arc.z1 * G1.z + p.y * e,
        trace * arc.z1 + by_s * arc.sz + by_z * arc.z2,
    );
}

// The rows (z, 0, -x) E, with E = 1 / h², and (z, 0, -x) F, with F = 1 / (h max(h, POLE |p|)).
fn longitude_curvature(p: vec3<f32>, G: vec3<f32>, of_ellipse: vec3<f32>) -> vec3<f32> {
    let h2 = max(p.x * p.x + p.z * p.z, 1e-37);
    let p2 = h2 + p.y * p.y;
    let least = POLE * sqrt(p2);
    let h = sqrt(h2);
    let E = 1.0 / h2;
    let F = 1.0 / (h * max(h, least));
    let dE = -2.0 * E * (G.x * p.z - G.z * p.x) / h2;             // by x and z, times x and z
    let dF = -F * (of_ellipse.x * p.z - of_ellipse.z * p.x);
    let close = h < least;
    let spread = dE + dF * (1.0 / h2 + select(1.0 / h2, 1.0 / p2, close));
    return vec3<f32>(
        -G.z * E - of_ellipse.z * F + p.x * spread,
        select(0.0, p.y * dF / p2, close),
        G.x * E + of_ellipse.x * F + p.z * spread,
    );
}

// The row (f_h x / h, f_y, f_h z / h), with f = atan2(y, h).
fn latitude_curvature(p: vec3<f32>, G: vec3<f32>) -> vec3<f32> {
    let h2 = max(p.x * p.x + p.z * p.z, 1e-37);
    let h = sqrt(h2);
    let p2 = h2 + p.y * p.y;
    let n = (p.x * G.x + p.z * G.z) / h;
    let f_h = -p.y / p2;
    let f_hh = 2.0 * h / p2 * (p.y / p2);
    let f_hy = (p.y * p.y - h2) / p2 / p2;
    let by_h = (f_hh * n + f_hy * G.y) / h;
    let turn = f_h * ((p.z * G.x - p.x * G.z) / h2) / h;           // G . d(x / h, z / h): z and -x times this
    return vec3<f32>(by_h * p.x + turn * p.z, f_hy * n - f_hh * G.y, by_h * p.z - turn * p.x);
}

// From the cotangents of decentring's shift and Jacobian to its place.
fn decentred_gradient(at: vec2<f32>, g: vec2<f32>, G0: vec2<f32>, G1: vec2<f32>) -> vec2<f32> {
    let p1 = coefficient(9u);
    let p2 = coefficient(10u);
    let x2 = 8.0 * coefficient(12u);
    let x4 = 8.0 * coefficient(14u);
    let Q = dot(at, at);
    let first = 2.0 * coefficient(11u) + 0.5 * x2 * Q;
    let second = 2.0 * coefficient(13u) + 0.5 * x4 * Q;
    let d = decentred_of(at);
    let AB = at.x * at.y;
    return d.K0 * g.x + d.K1 * g.y + vec2<f32>(
        G0.x * (6.0 * p2 + first + x2 * at.x * at.x) + G0.y * (2.0 * p1 + x2 * AB)
            + G1.x * (2.0 * p1 + second + x4 * at.x * at.x) + G1.y * (2.0 * p2 + x4 * AB),
        G0.x * (2.0 * p1 + x2 * AB) + G0.y * (2.0 * p2 + first + x2 * at.y * at.y)
            + G1.x * (2.0 * p2 + x4 * AB) + G1.y * (6.0 * p1 + second + x4 * at.y * at.y),
    );
}

// The same from R a and its Jacobian to a.
fn radial_gradient(a: vec2<f32>, g: vec2<f32>, G0: vec2<f32>, G1: vec2<f32>) -> vec2<f32> {
    let r = radial_of(dot(a, a));
    let mixed = G0.y + G1.x;
    let quadratic = 2.0 * (G0.x * a.x * a.x + mixed * a.x * a.y + G1.y * a.y * a.y);
    let by_R = dot(g, a) + G0.x + G1.y;
    let by_q = 2.0 * (r.first * by_R + r.second * quadratic);
    return r.R * g + 2.0 * r.first * (2.0 * vec2<f32>(G0.x, G1.y) * a + mixed * a.yx) + a * by_q;
}

// Cotangents of the parts of a distortion, if radial coefficients come first: K = (I + E) K_r with E at R a.
struct Parts {
    at: vec2<f32>,           // the place of decentring
    E0: vec2<f32>,           // of its Jacobian
    E1: vec2<f32>,
    R0: vec2<f32>,           // of the radial Jacobian
    R1: vec2<f32>,
    through: vec2<f32>,      // of R a
}

fn parts_of(a: vec2<f32>, g: vec2<f32>, G0: vec2<f32>, G1: vec2<f32>) -> Parts {
    if (view.lens[KIND].z == 0u) {
        return Parts(a, G0, G1, G0, G1, g);
    }
    let r = radial_of(dot(a, a));
    let k = radial_slope(r, a);
    var to: Parts;
    to.at = r.R * a;
    let d = decentred_of(to.at);
    to.E0 = vec2<f32>(dot(G0, k.xz), dot(G0, k.zy));
    to.E1 = vec2<f32>(dot(G1, k.xz), dot(G1, k.zy));
    to.R0 = G0 + d.K0.x * G0 + d.K1.x * G1;
    to.R1 = G1 + d.K0.y * G0 + d.K1.y * G1;
    to.through = g + decentred_gradient(to.at, g, to.E0, to.E1);
    return to;
}

fn distorted_gradient(a: vec2<f32>, g: vec2<f32>, G0: vec2<f32>, G1: vec2<f32>) -> vec2<f32> {
    let to = parts_of(a, g, G0, G1);
    let radial = radial_gradient(a, to.through, to.R0, to.R1);
    if (view.lens[KIND].z == 0u) {
        return radial + decentred_gradient(a, g, G0, G1);
    }
    return radial;
}

// Adds the gradient of the coefficients to `camera_parts` from a place on.
fn coefficient_gradient(place: u32, a: vec2<f32>, g: vec2<f32>, G0: vec2<f32>, G1: vec2<f32>) {
    let to = parts_of(a, g, G0, G1);
    let q = dot(a, a);
    let r = radial_of(q);
    let quadratic = 2.0 * (to.R0.x * a.x * a.x + (to.R0.y + to.R1.x) * a.x * a.y + to.R1.y * a.y * a.y);
    let by_R = dot(to.through, a) + to.R0.x + to.R1.y;
    var lower = 1.0;                                               // q^(i - 1)
    for (var i = 1u; i <= 6u; i++) {
        let value = lower * q * r.inverse;
        let slope = (f32(i) * lower - value * r.below1) * r.inverse;
        camera_parts[place + i - 1u] += by_R * value + quadratic * slope;
        if (i <= 3u) {
            let below = -r.R * value;                              // dR / dd_i
            let below_slope = (-r.R * f32(i) * lower - below * r.below1 - r.first * lower * q) * r.inverse;
            camera_parts[place + 5u + i] += by_R * below + quadratic * below_slope;
        }
        lower *= q;
    }
    let at = to.at;
    let Q = dot(at, at);
    let AB = at.x * at.y;
    let mixed = to.E0.y + to.E1.x;
    let rows = vec2<f32>(dot(to.E0, at), dot(to.E1, at));
    camera_parts[place + 9u] += 2.0 * AB * g.x + (Q + 2.0 * at.y * at.y) * g.y
        + 2.0 * (to.E0.x * at.y + mixed * at.x) + 6.0 * to.E1.y * at.y;
    camera_parts[place + 10u] += (Q + 2.0 * at.x * at.x) * g.x + 2.0 * AB * g.y
        + 6.0 * to.E0.x * at.x + 2.0 * (mixed * at.y + to.E1.y * at.x);
    let even = Q * g + 2.0 * rows;
    let steep = Q * (Q * g + 4.0 * rows);
    camera_parts[place + 11u] += even.x;
    camera_parts[place + 12u] += steep.x;
    camera_parts[place + 13u] += even.y;
    camera_parts[place + 14u] += steep.y;
}

// Cotangents before the focal lengths: of the place, and of the rows that `core_of` has with the distortion.
struct PlaneGradient {
    g: vec2<f32>,
    G0: vec3<f32>,
    G1: vec3<f32>,
    bounded: vec3<f32>,
}

fn plane_gradient(to: ImageGradient) -> PlaneGradient {
    let f = view.focal;
    let bounded = view.lens[KIND].x == EQUIRECTANGULAR;
    let e0 = f.x * to.e0;
    let none = vec3<f32>(0.0);
    return PlaneGradient(f * to.at, f.x * to.J0 + select(e0, none, bounded), f.y * (to.J1 + to.e1), select(none, e0, bounded));
}

// From an image to p.
fn image_gradient(p: vec3<f32>, to: ImageGradient) -> vec3<f32> {
    let on = core_of(p);
    let plane = plane_gradient(to);
    var da = plane.g;
    var G0 = plane.G0;
    var G1 = plane.G1;
    if (view.lens[KIND].y != 0u) {
        let k = distorted(on.place);
        let row0 = vec2<f32>(dot(G0, on.J0), dot(G0, on.J1));
        let row1 = vec2<f32>(dot(G1, on.J0), dot(G1, on.J1));
        da = distorted_gradient(on.place, plane.g, row0, row1);
        G0 = k.K0.x * plane.G0 + k.K1.x * plane.G1;
        G1 = k.K0.y * plane.G0 + k.K1.y * plane.G1;
    }
    return da.x * on.J0 + da.y * on.J1 + core_curvature(p, G0, G1, plane.bounded);
}

// Adds the gradient of fx, fy, cx, cy and the coefficients to `camera_parts` from a place on.
fn lens_gradient(place: u32, p: vec3<f32>, to: ImageGradient) {
    let on = core_of(p);
    let plane = plane_gradient(to);
    var at = on.place;
    var row0 = on.J0;
    var row1 = on.J1;
    if (view.lens[KIND].y != 0u) {
        let k = distorted(on.place);
        at = k.m;
        row0 = k.K0.x * on.J0 + k.K0.y * on.J1;
        row1 = k.K1.x * on.J0 + k.K1.y * on.J1;
        coefficient_gradient(
            place + 4u, on.place, plane.g,
            vec2<f32>(dot(plane.G0, on.J0), dot(plane.G0, on.J1)), vec2<f32>(dot(plane.G1, on.J0), dot(plane.G1, on.J1)),
        );
    }
    let by_f = vec2<f32>(dot(plane.G0, row0) + dot(plane.bounded, on.ellipse), dot(plane.G1, row1)) / view.focal;
    let focal = to.at * at + by_f;
    camera_parts[place] += focal.x;
    camera_parts[place + 1u] += focal.y;
    camera_parts[place + 2u] += to.at.x;
    camera_parts[place + 3u] += to.at.y;
}

// From `clamped_point` to p: a moved coordinate is a bound, which is constant, times z.
fn clamp_gradient(p: vec3<f32>, d: vec3<f32>) -> vec3<f32> {
    if (view.lens[AXIS].z == 0u) {
        return d;
    }
    let low = p.xy < view.low * p.z;
    let high = p.xy > view.high * p.z;
    let none = vec2<f32>(0.0);
    let along = dot(select(select(none, d.xy, high), none, low), view.high) + dot(select(none, d.xy, low), view.low);
    return vec3<f32>(select(select(d.xy, none, high), none, low), d.z + along);
}

// From an image point to p; `image` is that of p.
fn place_gradient(image: Image, at: vec2<f32>) -> vec3<f32> {
    return at.x * image.J0 + at.y * image.J1;
}

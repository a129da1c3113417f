// A mean seen by a camera with any projection, at rest or with a rolling shutter.
//
//     p(t) = C(w t) R (x - eye - V t),   (u, v) = image(p),   t = pace (q - middle),   q: v, or u of columns that are read in turn
//     rows of J W:   R' C' B,   B = J + k w_image (J of q),   w_image = J dp/dt,   k = pace / (1 - pace w_image of q)
//
//     blur:  exposure / sqrt(12) w_image / (1 - pace w_image of q)
//
// B of a perspective lens is that of the clamped point, whose J, dp/dt and k it takes; so does the blur. t is tau - 1/2, and pace is 0
// for a global shutter. Formulas and names are those of native/sight.cpp.

const SHUTTER_STEPS = 3;
const SETTLED = 0.1;         // largest distance between a point's row and the row at whose time it is seen, px
const FASTEST = 0.5;         // largest fraction of the readout's speed at which a point moves along it

var<private> seen_at: f32;   // t of the Gaussian that `project_mean` saw last

fn turning(v: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(dot(view.R0.xyz, v), dot(view.R1.xyz, v), dot(view.R2.xyz, v));
}

fn turning_back(v: vec3<f32>) -> vec3<f32> {
    return v.x * view.R0.xyz + v.y * view.R1.xyz + v.z * view.R2.xyz;
}

// Cayley's map of half the turn h: v + f (h x v + h x (h x v)). That of -h is its inverse.
fn cayley(h: vec3<f32>, f: f32, v: vec3<f32>) -> vec3<f32> {
    let once = cross(h, v);
    return v + f * (once + cross(h, once));
}

// A camera's view of a point at a time.
struct Moment {
    h: vec3<f32>,            // w t / 2
    f: f32,                  // 2 / (1 + |h|²)
    start: vec3<f32>,        // R (x - eye - V t)
    p: vec3<f32>,            // the same, turned
    shift: vec3<f32>,        // C R V
    rate: vec3<f32>,         // dp/dt
    speed: vec2<f32>,        // w_image
    image: Image,
}

// What the ellipse takes of a moment, at the clamped point.
struct Shear {
    p: vec3<f32>,
    rate: vec3<f32>,
    speed: vec2<f32>,
    follows: f32,            // 1 / (1 - pace w_image of q)
    k: f32,
    image: Image,
}

fn moment_of(at_rest: vec3<f32>, time: f32) -> Moment {
    let turn = lens_row(TURN);
    let shift = turning(lens_row(SHIFT).xyz);
    var m: Moment;
    m.h = 0.5 * time * turn.xyz;
    m.f = 2.0 / (1.0 + dot(m.h, m.h));
    m.start = at_rest - time * shift;
    m.p = cayley(m.h, m.f, m.start);
    m.shift = cayley(m.h, m.f, shift);
    m.rate = cross(0.5 * m.f * turn.xyz, m.p) - m.shift;
    m.image = image_of(m.p);
    m.speed = vec2<f32>(dot(m.image.J0, m.rate), dot(m.image.J1, m.rate));
    return m;
}

fn shear_of(m: Moment) -> Shear {
    let turn = lens_row(TURN);
    var s = Shear(m.p, m.rate, m.speed, 0.0, 0.0, m.image);
    if (view.lens[AXIS].z != 0u) {
        s.p = clamped_point(m.p);
        s.rate = cross(0.5 * m.f * turn.xyz, s.p) - m.shift;
        s.image = image_of(s.p);
        s.speed = vec2<f32>(dot(s.image.J0, s.rate), dot(s.image.J1, s.rate));
    }
    s.follows = 1.0 / (1.0 - turn.w * s.speed[view.lens[AXIS].x]);
    s.k = turn.w / (1.0 - turn.w * s.speed[view.lens[AXIS].x]);
    return s;
}

// Exposure / sqrt(12); 0 for no motion blur.
fn spread_of() -> f32 {
    return bitcast<f32>(view.lens[AXIS].w);
}

// t at which a rolling shutter sees a point, from its place in camera axes at half time: Newton's method.
fn time_of(at_rest: vec3<f32>) -> f32 {
    let axis = view.lens[AXIS].x;
    let pace = lens_row(TURN).w;
    let middle = lens_row(SHIFT).w;
    var q = image_of(at_rest).at[axis];
    for (var step = 0; step < SHUTTER_STEPS; step++) {
        let m = moment_of(at_rest, pace * (q - middle));
        q += (m.image.at[axis] - q) / (1.0 - pace * m.speed[axis]);
    }
    return pace * (q - middle);
}

fn offset_of(i: u32) -> vec3<f32> {
    return kept3(core3(i * CORE) - view.eye.xyz) - view.eye_rest.xyz;
}

// Whether the lens sees p at a depth.
fn sees(p: vec3<f32>, depth: f32) -> bool {
    let s = dot(p.xy, p.xy);
    let widest = lens_row(WIDEST).w;
    switch (view.lens[KIND].x) {
        case PERSPECTIVE: { return s <= widest * p.z * p.z; }
        case FISHEYE: { return p.z >= widest * depth; }
        case EQUIRECTANGULAR: { return p.x * p.x + p.z * p.z > POLAR * depth * depth; }
        default: { return true; }
    }
}

// Of the result, `p.z` is the depth, and `offset` points from the camera, when it sees the mean, to the mean.
fn project_mean(i: u32, g: ptr<function, Projected>) {
    let at_rest = turning(offset_of(i));
    let moves = view.lens[KIND].w != 0u;
    var p = at_rest;
    var image: Image;
    var b0: vec3<f32>;
    var b1: vec3<f32>;
    var slow = true;
    seen_at = 0.0;
    (*g).offset = offset_of(i);
    if (moves) {
        let axis = view.lens[AXIS].x;
        seen_at = time_of(at_rest);
        let m = moment_of(at_rest, seen_at);
        let own = shear_of(m);
        image = m.image;
        p = m.p;
        let fast = abs(lens_row(TURN).w) * max(abs(m.speed[axis]), abs(own.speed[axis]));
        var off = 0.0;
        if (lens_row(TURN).w != 0.0) {
            off = m.image.at[axis] - (seen_at / lens_row(TURN).w + lens_row(SHIFT).w);
        }
        (*g).blurred = spread_of() != 0.0;
        (*g).blur = spread_of() * own.follows * own.speed;
        slow = finite(seen_at) && finite(fast) && finite(off) && fast < FASTEST && abs(off) < SETTLED;
        let along = select(own.image.ellipse, own.image.J1, axis == 1u);
        b0 = cayley(-m.h, m.f, own.image.ellipse + own.k * own.speed.x * along);
        b1 = cayley(-m.h, m.f, own.image.J1 + own.k * own.speed.y * along);
        (*g).offset -= seen_at * lens_row(SHIFT).xyz;
    } else {
        image = image_of(p);
        let own = image_of(clamped_point(p));
        b0 = own.ellipse;
        b1 = own.J1;
    }
    if (view.lens[KIND].x == ORTHOGRAPHIC) {
        (*g).offset = view.R2.xyz;
    }
    let depth = select(p.z, sqrt(dot(p, p)), view.lens[AXIS].y != 0u);
    (*g).p = vec3<f32>(p.xy, depth);
    (*g).t0 = turning_back(b0);
    (*g).t1 = turning_back(b1);
    (*g).uv = image.at;
    (*g).valid = finite3(core3(i * CORE)) && finite(dot(p, p)) && depth > view.z_near && slow && sees(p, depth)
        && finite(image.at.x) && finite(image.at.y);
    (*g).nearest = clamp(image.at, vec2<f32>(0.0), vec2<f32>(view.size) - 1.0);
    if (view.lens[KIND].x == EQUIRECTANGULAR) {
        (*g).nearest.x = image.at.x;                         // never far outside; seam_shift wants it as it is
    }
}

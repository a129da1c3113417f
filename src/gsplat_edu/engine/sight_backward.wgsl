// The adjoint of sight.wgsl: from the rows of J W and the position in the image to the mean, the camera, its lens and its motion.
//
// It follows the implicit function theorem: with S, the cotangent of t at fixed parameters, the image position q gets k S in addition.
// native/sight.cpp has the same.

const CAMERA = 37u;          // R row by row, eye, fx, fy, cx, cy; coefficients 15, turn 3, shift 3
const LENS_AT = 12u;
const TURN_AT = 31u;
const SHIFT_AT = 34u;

var<workgroup> camera_parts: array<f32, 2368>;   // 64 threads x CAMERA

// Cotangents of h and of f of Cayley's map.
struct TurnGradient {
    half: vec3<f32>,
    f: f32,
}

// Adds what the map of v passes on, whose result has the cotangent c.
fn cayley_gradient(m: Moment, v: vec3<f32>, c: vec3<f32>, to: ptr<function, TurnGradient>) {
    let once = cross(m.h, v);
    (*to).half += m.f * (cross(v, c) + cross(once, c) + cross(v, cross(c, m.h)));
    (*to).f += dot(c, once + cross(m.h, once));
}

// Adds a' b to the gradient of R.
fn add_outer(place: u32, a: vec3<f32>, b: vec3<f32>) {
    for (var j = 0u; j < 3u; j++) {
        for (var k = 0u; k < 3u; k++) {
            camera_parts[place + 3u * j + k] += a[j] * b[k];
        }
    }
}

fn store3(place: u32, v: vec3<f32>) {
    for (var k = 0u; k < 3u; k++) {
        camera_parts[place + k] = v[k];
    }
}

fn depth_gradient(p: vec3<f32>, depth: f32) -> vec3<f32> {
    return select(vec3<f32>(0.0, 0.0, depth), p * (depth / sqrt(max(dot(p, p), 1e-37))), view.lens[AXIS].y != 0u);
}

// Of a camera at rest: returns the gradient of the mean without the direction's part.
fn through_still(place: u32, offset: vec3<f32>, depth: f32, to: Through) -> vec3<f32> {
    let none = vec3<f32>(0.0);
    let p = turning(offset);
    let inside = clamped_point(p);
    let bounded = view.lens[AXIS].z != 0u;
    var rows = ImageGradient(to.uv, none, none, turning(to.d0), turning(to.d1));
    var dp = depth_gradient(p, depth);
    if (bounded) {                                                 // the image point is that of p, the rows those of `inside`
        rows.at = vec2<f32>(0.0);
        dp += place_gradient(image_of(p), to.uv);
        lens_gradient(place + LENS_AT, p, ImageGradient(to.uv, none, none, none, none));
    }
    dp += clamp_gradient(p, image_gradient(inside, rows));
    let image = image_of(inside);
    lens_gradient(place + LENS_AT, inside, rows);
    add_outer(place, dp, offset);
    add_outer(place, image.ellipse, to.d0);
    add_outer(place, image.J1, to.d1);
    return turning_back(dp);
}

// What the rows of J W pass on in a moment.
struct RowsGradient {
    image: ImageGradient,    // at the point of the ellipse; of the image point only if that is the mean's
    B0: vec3<f32>,           // J + k w_image (J of q)
    B1: vec3<f32>,
    rows0: vec3<f32>,        // C R d0, the cotangent of B0
    rows1: vec3<f32>,
    y: vec3<f32>,            // of dp/dt at the point of the ellipse
}

fn rows_gradient(m: Moment, s: Shear, to: Through) -> RowsGradient {
    let by_columns = view.lens[AXIS].x == 0u;
    let along = select(s.image.J1, s.image.ellipse, by_columns);
    var r: RowsGradient;
    r.rows0 = cayley(m.h, m.f, turning(to.d0));
    r.rows1 = cayley(m.h, m.f, turning(to.d1));
    let reach = vec2<f32>(dot(along, r.rows0), dot(along, r.rows1));
    var by_speed = s.k * reach;
    let by_k = s.k * s.k * dot(s.speed, reach);
    by_speed += select(vec2<f32>(0.0, by_k), vec2<f32>(by_k, 0.0), by_columns);
    if (spread_of() != 0.0) {                    // d follows / d speed = pace follows²
        let by_follows = s.follows * s.k * spread_of() * dot(to.blur, s.speed);
        by_speed += spread_of() * s.follows * to.blur + select(vec2<f32>(0.0, by_follows), vec2<f32>(by_follows, 0.0), by_columns);
    }
    r.B0 = s.image.ellipse + s.k * s.speed.x * along;
    r.B1 = s.image.J1 + s.k * s.speed.y * along;
    let more = s.k * (s.speed.x * r.rows0 + s.speed.y * r.rows1);
    let none = vec3<f32>(0.0);
    r.image = ImageGradient(
        select(to.uv, vec2<f32>(0.0), view.lens[AXIS].z != 0u), by_speed.x * s.rate, by_speed.y * s.rate,
        r.rows0 + select(none, more, by_columns), r.rows1 + select(more, none, by_columns),
    );
    r.y = by_speed.x * s.image.J0 + by_speed.y * s.image.J1;
    return r;
}

// The same of a camera with a rolling shutter.
fn through_moving(place: u32, offset: vec3<f32>, depth: f32, direction: vec3<f32>, to: Through) -> vec3<f32> {
    let m = moment_of(turning(offset), seen_at);
    let turn = lens_row(TURN).xyz;
    let V = lens_row(SHIFT).xyz;
    let axis = view.lens[AXIS].x;
    let own = shear_of(m);
    let bounded = view.lens[AXIS].z != 0u;
    let none = vec3<f32>(0.0);
    var r = rows_gradient(m, own, to);
    var dp = clamp_gradient(m.p, image_gradient(own.p, r.image) + 0.5 * m.f * cross(r.y, turn)) + depth_gradient(m.p, depth);
    if (bounded) {
        dp += place_gradient(m.image, to.uv);
    }
    let df = -0.5 * m.f * m.f * dot(m.h, turn);
    let spun = dot(r.y, cross(turn, own.p));
    var S = dot(dp, m.rate) + 0.5 * df * spun - 0.5 * m.f * dot(r.y, cross(turn, m.shift));
    S += 0.5 * m.f * (dot(r.B0, cross(turn, r.rows0)) + dot(r.B1, cross(turn, r.rows1)));
    S -= dot(direction, V);
    let pace = lens_row(TURN).w;
    let more = pace / (1.0 - pace * m.speed[axis]) * S;
    dp += more * select(m.image.J1, m.image.J0, axis == 0u);
    let of_place = select(vec2<f32>(0.0, more), vec2<f32>(more, 0.0), axis == 0u);
    let back = cayley(-m.h, m.f, dp);
    let dmean = turning_back(back);
    if (bounded) {
        lens_gradient(place + LENS_AT, m.p, ImageGradient(to.uv + of_place, none, none, none, none));
    } else {
        r.image.at += of_place;
    }
    lens_gradient(place + LENS_AT, own.p, r.image);
    let of_shift = cayley(-m.h, m.f, -r.y);                        // of R V
    add_outer(place, back, offset - seen_at * V);
    add_outer(place, of_shift, V);
    add_outer(place, cayley(-m.h, m.f, r.B0), to.d0);
    add_outer(place, cayley(-m.h, m.f, r.B1), to.d1);
    store3(place + SHIFT_AT, turning_back(of_shift) - seen_at * (dmean + direction));
    var by_turn = TurnGradient(vec3<f32>(0.0), 0.5 * spun);
    cayley_gradient(m, m.start, dp, &by_turn);
    cayley_gradient(m, turning(V), -r.y, &by_turn);
    cayley_gradient(m, turning(to.d0), r.B0, &by_turn);
    cayley_gradient(m, turning(to.d1), r.B1, &by_turn);
    let half = by_turn.half - m.f * m.f * by_turn.f * m.h;
    store3(place + TURN_AT, 0.5 * (m.f * cross(own.p, r.y) + seen_at * half));
    return dmean;
}

// Stores the gradient of the mean in `to`, and the camera's: from that of the depth, of the direction to the mean, and what `to` has.
fn through_camera(i: u32, thread: u32, g: Projected, depth: f32, direction: vec3<f32>, to: ptr<function, Through>) {
    let place = thread * CAMERA;
    let flat = view.lens[KIND].x == ORTHOGRAPHIC;               // its direction is R's last row
    let seen = select(direction, vec3<f32>(0.0), flat);
    if (view.lens[KIND].w != 0u) {
        (*to).mean = seen + through_moving(place, offset_of(i), depth, seen, *to);
    } else {
        (*to).mean = seen + through_still(place, offset_of(i), depth, *to);
    }
    if (flat) {
        for (var k = 0u; k < 3u; k++) {
            camera_parts[place + 6u + k] += direction[k];
        }
    }
    store3(place + 9u, -(*to).mean);
}

// project_backward: add each Gaussian's slots in order, and propagate the sums to its raw parameters and to the camera.
//
//     moments of h -> J W M -> (J W, quaternion, log scale) -> mean;   colour -> (coefficients, direction -> mean)
//
// Sigma2d^-1 = L' L, y = L d: moments are taken in y, where they are of order 1; in d they grow with the ellipse and cancel.
// With r = (J W) M, w = L r and N the matrix of moments: dL/dr = L' N w. From J W and the position to the mean, `through_camera` is
// that of pinhole_backward.wgsl or of sight_backward.wgsl.

const OUT = 16u;             // as `core`, then |(gu W/2, gv H/2)|, and one unused
const SLOT = 10u;

@group(1) @binding(2) var<storage, read> spans: array<vec2<u32>>;
@group(1) @binding(3) var<storage, read> slots: array<f32>;
@group(1) @binding(4) var<storage, read_write> core_grads: array<f32>;
@group(1) @binding(5) var<storage, read_write> rest_grads: array<f32>;
@group(1) @binding(6) var<storage, read_write> camera_sums: array<f32>;

struct Sums {
    color: vec3<f32>,
    depth: f32,
    h: f32,
    first: vec2<f32>,
    second: vec3<f32>,       // hxx, hxy, hyy
}

struct Moments {
    L: vec3<f32>,            // sx, sy, ty
    m: vec2<f32>,            // sum h y
    m00: f32,                // sum h y y', minus sum h on the diagonal with antialiasing or motion blur
    m01: f32,
    m11: f32,
}

struct Through {             // gradients on their way
    d0: vec3<f32>,           // of the rows of J W
    d1: vec3<f32>,
    total: f32,              // d0 . t0 + d1 . t1
    uv: vec2<f32>,           // of the position in the image
    blur: vec2<f32>,
    p: vec3<f32>,            // of the mean in camera axes
    mean: vec3<f32>,
}

fn sum_slots(span: vec2<u32>) -> Sums {
    var sums = Sums(vec3<f32>(0.0), 0.0, 0.0, vec2<f32>(0.0), vec3<f32>(0.0));
    for (var k = 0u; k < span.x; k++) {
        let at = (span.y + k) * SLOT;
        sums.color += vec3<f32>(slots[at], slots[at + 1u], slots[at + 2u]);
        sums.depth += slots[at + 3u];
        sums.h += slots[at + 4u];
        sums.first += vec2<f32>(slots[at + 5u], slots[at + 6u]);
        sums.second += vec3<f32>(slots[at + 7u], slots[at + 8u], slots[at + 9u]);
    }
    return sums;
}

// Turns moments about the reference point into moments of y about the mean.
fn whiten(g: Projected, sums: Sums) -> Moments {
    var w: Moments;
    w.L = whitening(g);
    let d = g.nearest - g.uv;
    let s = w.L.x * d.x + w.L.y * d.y;           // y of the reference point
    let t = w.L.z * d.y;
    let along = w.L.x * sums.first.x + w.L.y * sums.first.y;
    let down = w.L.z * sums.first.y;
    w.m = vec2<f32>(s * sums.h + along, t * sums.h + down);
    w.m00 = s * (s * sums.h + 2.0 * along)
        + w.L.x * (w.L.x * sums.second.x + 2.0 * w.L.y * sums.second.y) + w.L.y * w.L.y * sums.second.z;
    w.m01 = s * (t * sums.h + down) + t * along + w.L.z * (w.L.x * sums.second.y + w.L.y * sums.second.z);
    w.m11 = t * (t * sums.h + 2.0 * down) + w.L.z * w.L.z * sums.second.z;
    if (view.antialiased != 0u || g.blurred) {   // the opacity's factor contains det^(-1/2)
        w.m00 -= sums.h;
        w.m11 -= sums.h;
    }
    return w;
}

// dL/dq of a unit quaternion from the gradient of a rotation about the Gaussian's own axes: 2 q (0, torque).
fn turn_gradient(q: vec4<f32>, torque: vec3<f32>) -> vec4<f32> {
    return 2.0 * vec4<f32>(-dot(q.yzw, torque), q.x * torque + cross(q.yzw, torque));
}

// Propagates the moments to scales and quaternion, which it stores, to the rows of J W, and to the blur, a fourth column of r. `lit` is
// the opacity's part: its factor contains det0^(1/2), so dL/dr = sum h Sigma^-1 r with Sigma before the dilation or, with motion blur
// and no antialiasing, after: then `lit_dilation` is not 0.
//
// With p = (J W) R, r = p S and W = L p: dL/dr = B r with a symmetric B, so with Q = p' B p the scales get s_k² Q_kk and a
// turn about axis i gets Q_jk (s_j² - s_k²). That is exactly 0 for a round Gaussian, whose quaternion Adam would move otherwise,
// by a whole step for each rounding error. With f = t0 x t1 in the Gaussian's axes, antialiasing's part of Q_jk is
// -lit s_i² f_j f_k, and that of Q_kk is lit (s_i² f_j² + s_j² f_i²): no term cancels. The dilation's part of Q is
// lit d (p0' p0 + p1' p1).
fn shape_gradient(i: u32, g: Projected, m: Moments, lit: f32, lit_dilation: f32, to: ptr<function, Through>) {
    let p0 = g.t0 * g.R;
    let p1 = g.t1 * g.R;
    let flat = cross(g.t0, g.t1) * g.R;
    let ss = g.s * g.s;
    let across0 = cross(p1 * ss, flat);          // (c0 r0 - b0 r1) / s
    let across1 = cross(flat, p0 * ss);          // (a0 r1 - b0 r0) / s
    var w0 = m.L.x / g.c * (view.dilation * p0 + across0);        // sx p0 + sy p1 = sx (p0 - b/c p1)
    let w1 = m.L.z * p1;
    let even = lit * lit_dilation;
    if (g.blurred) {
        w0 += m.L.x / g.c * g.blur.y * (g.blur.y * p0 - g.blur.x * p1);
        let along = g.blur.x * g.r1 - g.blur.y * g.r0;
        let b0 = m.L.x / g.c * (view.dilation * g.blur.x + dot(g.r1, along));
        let b1 = m.L.z * g.blur.y;
        let db0 = m.m00 * b0 + m.m01 * b1;
        (*to).blur = vec2<f32>(m.L.x * db0, m.L.y * db0 + m.L.z * (m.m01 * b0 + m.m11 * b1));
    }
    let dw0 = m.m00 * w0 + m.m01 * w1;
    let dw1 = m.m01 * w0 + m.m11 * w1;
    var extra0 = lit * across0;
    var extra1 = lit * across1;
    var scale = ss * (w0 * dw0 + w1 * dw1 + lit * (ss.yzx * flat.zxy * flat.zxy + ss.zxy * flat.yzx * flat.yzx));
    var Q = w0.yzx * dw0.zxy + w1.yzx * dw1.zxy - lit * ss * flat.yzx * flat.zxy;
    if (g.blurred) {
        extra0 += even * p0;
        extra1 += even * p1;
        scale += even * ss * (p0 * p0 + p1 * p1);
        Q += even * (p0.yzx * p0.zxy + p1.yzx * p1.zxy);
    }
    (*to).d0 = g.R * (ss * (m.L.x * dw0 + extra0));
    (*to).d1 = g.R * (ss * (m.L.y * dw0 + m.L.z * dw1 + extra1));
    (*to).total = scale.x + scale.y + scale.z;
    let torque = Q * (g.s.yzx - g.s.zxy) * (g.s.yzx + g.s.zxy);
    let dq = turn_gradient(g.q, torque) / g.q_length;
    for (var k = 0u; k < 4u; k++) {
        core_grads[i * OUT + 3u + k] = dq[k];
    }
    for (var k = 0u; k < 3u; k++) {
        core_grads[i * OUT + 7u + k] = scale[k];
    }
}

// Propagates the colour's gradient to the coefficients, which it stores, and returns that of the direction to the mean.
fn color_gradient(i: u32, g: Projected, painted: vec3<f32>) -> vec3<f32> {
    let distance = sqrt(dot(g.offset, g.offset));
    let d = g.offset / distance;
    let dc = select(vec3<f32>(0.0), painted, color_along(i, d) > vec3<f32>(0.0));
    for (var k = 0u; k < 3u; k++) {
        core_grads[i * OUT + 10u + k] = C0 * dc[k];
    }
    var turned = vec3<f32>(0.0);
    let stored = bound_of(i, view.rest);
    for (var j = 1u; j <= stored; j++) {
        let at = 3u * (i * view.rest + j - 1u);
        var basis = 0.0;
        if (j < (view.degree + 1u) * (view.degree + 1u)) {
            basis = harmonic(j, d);
            turned += dot(vec3<f32>(rest[at], rest[at + 1u], rest[at + 2u]), dc) * harmonic_slope(j, d);
        }
        for (var k = 0u; k < 3u; k++) {
            rest_grads[at + k] = basis * dc[k];
        }
    }
    return (turned - dot(turned, d) * d) / distance;
}

fn clear(i: u32) {
    for (var k = 0u; k < OUT; k++) {
        core_grads[i * OUT + k] = 0.0;
    }
    let numbers = 3u * bound_of(i, view.rest);
    for (var k = 0u; k < numbers; k++) {
        rest_grads[3u * i * view.rest + k] = 0.0;
    }
}

fn differentiate(i: u32, thread: u32) {
    let g = project_shape(i);
    if (!g.valid) {              // rounded to the other side of a bound than in project
        clear(i);
        return;
    }
    let sums = sum_slots(spans[i]);
    let m = whiten(g, sums);
    var to: Through;
    to.uv = vec2<f32>(m.L.x * m.m.x, m.L.y * m.m.x + m.L.z * m.m.y);
    var lit = 0.0;
    var lit_dilation = 0.0;
    if (view.antialiased == 0u && g.blurred) {
        lit = sums.h / g.still;
        lit_dilation = view.dilation;
    }
    if (view.antialiased != 0u && g.det0 > DET_FLOOR) {
        lit = sums.h / g.det0;
    }
    shape_gradient(i, g, m, lit, lit_dilation, &to);
    through_camera(i, thread, g, sums.depth, color_gradient(i, g, sums.color), &to);
    for (var k = 0u; k < 3u; k++) {
        core_grads[i * OUT + k] = to.mean[k];
    }
    core_grads[i * OUT + 13u] = g.transparency * sums.h;
    let screen = to.uv * 0.5 * vec2<f32>(view.size);
    core_grads[i * OUT + 14u] = sqrt(dot(screen, screen));
    core_grads[i * OUT + 15u] = 0.0;
}

@compute @workgroup_size(64)
fn project_backward(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                    @builtin(local_invocation_index) thread: u32) {
    let block = group_of(id, groups);
    let i = block * 64u + thread;
    for (var k = 0u; k < CAMERA; k++) {
        camera_parts[thread * CAMERA + k] = 0.0;
    }
    if (i < job.count) {
        if (spans[i].x > 0u) {
            differentiate(i, thread);
        } else {
            clear(i);
        }
    }
    workgroupBarrier();
    if (thread < CAMERA && block < job.blocks) {
        var sum = 0.0;
        for (var k = 0u; k < 64u; k++) {
            sum += camera_parts[k * CAMERA + thread];
        }
        camera_sums[block * CAMERA + thread] = sum;
    }
}

// From the rows of J W and the position in the image to the mean and to a pinhole at rest.

const CAMERA = 16u;          // R row by row, eye, fx, fy, cx, cy

var<workgroup> camera_parts: array<f32, 1024>;   // 64 threads x CAMERA

// Propagates to the mean in camera axes. J W = f/z (W_row - x/z W_2): d/dx gives -f/z² W_2; d/dz gives -(J W)/z + f x/z³
// W_2. A clamped x/z is a constant.
fn mean_gradient(g: Projected, depth: f32, to: ptr<function, Through>) {
    let plain = g.p.xy / g.p.z;
    let along = vec2<f32>(dot((*to).d0, view.R2.xyz), dot((*to).d1, view.R2.xyz));
    let w = select(along, vec2<f32>(0.0), g.clamped);
    let f = view.focal / g.p.z;
    let flat = f * (*to).uv - f / g.p.z * w;
    let deep = (dot(f * plain, w) - (*to).total) / g.p.z - dot(plain * f, (*to).uv) + depth;
    (*to).p = vec3<f32>(flat, deep);
}

// All formulas take R (mean - eye), so the eye's gradient is minus that of the mean. A clamped x/z is a bound of the image,
// (constant - cx) / fx.
fn camera_gradient(thread: u32, g: Projected, to: Through) {
    let f = view.focal / g.p.z;
    let along = vec2<f32>(dot(to.d0, view.R2.xyz), dot(to.d1, view.R2.xyz)) / g.p.z;
    let w = select(vec2<f32>(0.0), along, g.clamped);
    let row0 = to.p.x * g.offset + f.x * to.d0;
    let row1 = to.p.y * g.offset + f.y * to.d1;
    let row2 = to.p.z * g.offset - f.x * g.ratio.x * to.d0 - f.y * g.ratio.y * to.d1;
    let focal = to.uv * g.p.xy / g.p.z + vec2<f32>(dot(to.d0, g.t0), dot(to.d1, g.t1)) / view.focal + w * g.ratio;
    let middle = to.uv + w;
    let at = thread * CAMERA;
    for (var k = 0u; k < 3u; k++) {
        camera_parts[at + k] = row0[k];
        camera_parts[at + 3u + k] = row1[k];
        camera_parts[at + 6u + k] = row2[k];
        camera_parts[at + 9u + k] = -to.mean[k];
    }
    for (var k = 0u; k < 2u; k++) {
        camera_parts[at + 12u + k] = focal[k];
        camera_parts[at + 14u + k] = middle[k];
    }
}

// Stores the gradient of the mean in `to`, from those of its depth and of the direction to it besides what `to` has; and the camera's.
fn through_camera(i: u32, thread: u32, g: Projected, depth: f32, direction: vec3<f32>, to: ptr<function, Through>) {
    mean_gradient(g, depth, to);
    (*to).mean = (*to).p.x * view.R0.xyz + (*to).p.y * view.R1.xyz + (*to).p.z * view.R2.xyz + direction;
    camera_gradient(thread, g, *to);
}

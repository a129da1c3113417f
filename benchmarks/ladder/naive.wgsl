// The plainest kernel on a GPU: one invocation is one pixel, and reads every splat, near to far.

struct Mark {                                         // a splat on the screen, nine floats
    u: f32, v: f32,                                   // its mean, px
    A: f32, B: f32, C: f32,                           // its conic, px^-2
    r: f32, g: f32, b: f32,
    opacity: f32,
}

@group(1) @binding(0) var<storage, read> live: array<u32>;               // its first number is that of the splats
@group(1) @binding(1) var<storage, read> marks: array<Mark>;
@group(1) @binding(2) var<storage, read_write> image: array<vec4<f32>>;  // r, g, b, T

@compute @workgroup_size(64)
fn naive(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
         @builtin(local_invocation_index) thread: u32) {
    let pixel = 64u * group_of(id, groups) + thread;
    if (pixel >= job.count) {                         // the last workgroup has more invocations than pixels are left
        return;
    }
    let x = f32(pixel % view.size.x);
    let y = f32(pixel / view.size.x);
    var color = vec3<f32>(0.0);
    var T = 1.0;
    for (var i = 0u; i < live[0]; i++) {
        let m = marks[i];
        let dx = x - m.u;
        let dy = y - m.v;
        let power = -0.5 * (m.A * dx * dx + m.C * dy * dy) - m.B * dx * dy;
        let alpha = min(view.alpha_max, m.opacity * exp(power));
        if (alpha < ALPHA_MIN) {
            continue;
        }
        let w = T * alpha;
        color += w * vec3<f32>(m.r, m.g, m.b);
        T -= w;
    }
    image[pixel] = vec4<f32>(color, T);
}

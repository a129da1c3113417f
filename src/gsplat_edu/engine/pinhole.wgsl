// A mean seen by a pinhole at rest.
//
//     u = fx x/z + cx,   v = fy y/z + cy

fn project_mean(i: u32, g: ptr<function, Projected>) {
    let mean = core3(i * CORE);
    let offset = kept3(mean - view.eye.xyz) - view.eye_rest.xyz;
    let p = vec3<f32>(dot(view.R0.xyz, offset), dot(view.R1.xyz, offset), dot(view.R2.xyz, offset));
    (*g).valid = finite3(mean) && finite(p.x + p.y + p.z * p.z) && p.z > view.z_near;
    let z = select(1.0, p.z, (*g).valid);
    (*g).offset = offset;
    (*g).p = vec3<f32>(p.xy, z);
    let plain = p.xy / z;
    (*g).ratio = clamp(plain, view.low, view.high);
    (*g).clamped = vec2<bool>(plain.x < view.low.x || plain.x > view.high.x, plain.y < view.low.y || plain.y > view.high.y);
    (*g).t0 = view.focal.x / z * (view.R0.xyz - (*g).ratio.x * view.R2.xyz);
    (*g).t1 = view.focal.y / z * (view.R1.xyz - (*g).ratio.y * view.R2.xyz);
    (*g).uv = view.focal * plain + view.middle;
    (*g).valid = (*g).valid && finite((*g).uv.x) && finite((*g).uv.y);
    (*g).nearest = clamp((*g).uv, vec2<f32>(0.0), vec2<f32>(view.size) - 1.0);
}

// project: a record for each Gaussian, and the number of tiles that it meets.
//
//     alpha = 2^(log2 o - s² - t²),   s = s0 + sx dx + sy dy,   t = t0 + ty dy
//
// (dx, dy) is the pixel minus the point of the image nearest to the mean, so a mean far outside costs no digits. Two
// squares cannot cancel; the terms of a polynomial in dx and dy do if an ellipse is longer than it is wide.
// A record is four rows: (x, y, sx, sy), (ty, s0, t0, log2 o), (colour, depth), (u, v, half width, half height). Where the depth
// is 0, the Gaussian is not drawn.

@group(1) @binding(2) var<storage, read_write> records: array<vec4<f32>>;
@group(1) @binding(3) var<storage, read_write> seen: array<u32>;
@group(1) @binding(4) var<storage, read_write> spans: array<vec2<u32>>;

fn count_tiles(e: Ellipse) -> u32 {
    var total = 0;
    for (var row = e.first; row <= e.last; row++) {
        for (var copy = 0; copy < COPIES; copy++) {
            total += run_of(e, row, copy).y;
        }
    }
    return u32(total);
}

@compute @workgroup_size(64)
fn project(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
           @builtin(local_invocation_index) thread: u32) {
    let i = group_of(id, groups) * 64u + thread;
    if (i >= job.count) {
        return;
    }
    records[4u * i + 2u] = vec4<f32>(0.0);
    seen[i] = 0u;
    spans[i] = vec2<u32>(0u);
    let g = project_shape(i);
    if (!g.valid) {
        return;
    }
    let log2_o = log2(g.opacity * g.compensation);
    let level = max(2.0 * LN2 * (log2_o - LOG2_ALPHA_MIN), 0.0);
    let extent = sqrt(level * vec2<f32>(g.a, g.c));
    let rim = extent + vec2<f32>(rim_slack(abs(g.uv.x) + extent.x), rim_slack(abs(g.uv.y) + extent.y));
    let farthest = vec2<f32>(view.size) - 1.0;
    if (any(g.uv - rim > farthest) || any(g.uv + rim < vec2<f32>(0.0))) {
        return;
    }
    let color = color_along(i, g.offset / sqrt(dot(g.offset, g.offset)));
    if (!finite3(color) || any(abs(color) > vec3<f32>(COLOR_LIMIT))) {
        return;
    }
    let w = whitening(g) * SQRT_HALF_LOG2E;
    let d = g.nearest - g.uv;
    let a = vec4<f32>(g.nearest, w.x, w.y);
    let b = vec4<f32>(w.z, w.x * d.x + w.y * d.y, w.z * d.y, log2_o);
    let c = vec4<f32>(g.uv, extent);
    records[4u * i] = a;
    records[4u * i + 1u] = b;
    records[4u * i + 3u] = c;
    records[4u * i + 2u] = vec4<f32>(max(color, vec3<f32>(0.0)), g.p.z);
    seen[i] = 1u;
    spans[i].x = count_tiles(ellipse_of(a, b, c));
}

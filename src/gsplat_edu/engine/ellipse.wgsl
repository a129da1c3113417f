// The tiles that an ellipse alpha >= 1/255 meets: (sx dx + sy dy)² + (ty dy)² <= L, a run of tiles in each row of them.
//
// Its x interval over a band of rows ends at the rightmost (leftmost) point of the ellipse if that lies in the band,
// otherwise at the edge of the band nearest to that point. As in native/intersect.cpp.

struct Ellipse {
    uv: vec2<f32>,
    extent: vec2<f32>,       // half width and height
    tangent: f32,            // at height dy the ellipse spans dx = tangent dy +- half sqrt(1 - (dy / ey)²)
    half: f32,
    rightmost: f32,          // dy of the rightmost point
    slack: f32,              // margin in x for rounding
    first: i32,              // rows of tiles
    last: i32,
}

// Bound on the rounding error of a rim, px, if it is computed from numbers whose magnitudes add up to `size`.
fn rim_slack(size: f32) -> f32 {
    return RIM_SLACK + 4.76837158e-7 * size;
}

// Takes the rows of a record but the colour: (x, y, sx, sy), (ty, s0, t0, log2 o), (u, v, half width, half height).
fn ellipse_of(a: vec4<f32>, b: vec4<f32>, c: vec4<f32>) -> Ellipse {
    var e: Ellipse;
    let sx = a.z;
    let sy = a.w;
    let ty = b.x;
    let height = f32(view.size.y);
    e.uv = c.xy;
    e.extent = c.zw;
    e.tangent = -sy / sx;
    e.half = sqrt(max(b.w - LOG2_ALPHA_MIN, 0.0)) / sx;
    e.rightmost = -(sx * sy / (sy * sy + ty * ty)) * e.extent.x;
    let above = rim_slack(abs(e.uv.y) + e.extent.y);
    let first = i32(min(max(ceil(e.uv.y - e.extent.y - above), 0.0), height));
    let last = i32(max(min(floor(e.uv.y + e.extent.y + above), height - 1.0), -1.0));
    e.slack = rim_slack(abs(e.uv.x) + abs(e.tangent) * min(e.extent.y, abs(e.uv.y) + height) + e.half);
    e.first = first / TILE;
    e.last = select(last / TILE, e.first - 1, first > last);
    return e;
}

// The first column of tiles in a row of them, and the number of tiles.
fn columns_of(e: Ellipse, row: i32) -> vec2<i32> {
    var low = max(f32(row * TILE) - e.uv.y, -e.extent.y);
    var high = min(f32(row * TILE + TILE - 1) - e.uv.y, e.extent.y);
    if (low > high) {        // a row that only the slack meets
        low = (low + high) / 2.0;
        high = low;
    }
    let right = clamp(e.rightmost, low, high);
    let left = clamp(-e.rightmost, low, high);
    let ey = max(e.extent.y, 1e-30);
    let yr = right / ey;
    let yl = left / ey;
    let width = f32(view.size.x);
    let x1 = e.uv.x + e.tangent * right + e.half * sqrt(max(1.0 - yr * yr, 0.0)) + e.slack;
    let x0 = e.uv.x + e.tangent * left - e.half * sqrt(max(1.0 - yl * yl, 0.0)) - e.slack;
    let c0 = i32(min(max(ceil(x0), 0.0), width));
    let c1 = i32(max(min(floor(x1), width - 1.0), -1.0));
    return vec2<i32>(c0 / TILE, select(0, c1 / TILE - c0 / TILE + 1, c0 <= c1));
}

// The same of one of the `COPIES` of an ellipse, 360 degrees apart: the tiles to which that one is the nearest.
fn run_of(e: Ellipse, row: i32, copy: i32) -> vec2<i32> {
    if (COPIES == 1) {
        return columns_of(e, row);
    }
    let shift = f32(copy - 1) * f32(view.size.x);
    var moved = e;
    moved.uv.x += shift;
    moved.slack += rim_slack(abs(shift)) - RIM_SLACK;
    var run = columns_of(moved, row);
    while (run.y > 0 && seam_shift(u32(run.x * TILE), e.uv.x) != shift) {
        run += vec2<i32>(1, -1);
    }
    while (run.y > 0 && seam_shift(u32((run.x + run.y - 1) * TILE), e.uv.x) != shift) {
        run.y -= 1;
    }
    return run;
}

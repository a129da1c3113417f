// A panorama, whose left and right edges meet: a splat has places 360 degrees apart, and each tile sees the nearest one.

const COPIES = 3;

// Whole turns, px, by which a splat at column u is moved to be nearest to the tile of a column.
fn seam_shift(column: u32, u: f32) -> f32 {
    let turn = f32(view.size.x);
    let middle = f32(column / u32(TILE) * u32(TILE)) + 0.5 * f32(TILE - 1);
    return turn * floor((middle - u) * (1.0 / turn) + 0.5);
}

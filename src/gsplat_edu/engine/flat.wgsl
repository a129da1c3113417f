// An image whose left and right edges do not meet: a splat has one place in it.

const COPIES = 1;

// Whole turns, px, by which a splat at column u is moved to be nearest to the tile of a column.
fn seam_shift(column: u32, u: f32) -> f32 {
    return 0.0;
}

"""intersect: find exactly the tiles that an ellipse alpha >= 1/255 touches, and write the pairs of Gaussian and tile.

The ellipse's x interval over a band of rows is computed as in `native/intersect.cpp`. Gaussians arrive near to far, so
pairs are written in depth order, and a stable sort by tile leaves every tile's list sorted by depth.

The left and right edges of a panorama meet (WRAPS): an ellipse has three places there, 360 degrees apart, and each tile
sees the nearest one.
"""

from __future__ import annotations

import math
from typing import no_type_check

import triton
import triton.language as tl

from gsplat_edu.base import constants
from gsplat_edu.render.cuda.project import RECORD

TILE = tl.constexpr(constants.TILE)
LOG2_ALPHA_MIN = tl.constexpr(math.log2(constants.ALPHA_MIN))
RIM_SLACK = tl.constexpr(constants.RIM_SLACK)


@triton.jit
@no_type_check
def _ellipse(records, i, mask):
    """Return centre, half extents, slope of the rightmost point, tangent and half width of the ellipse."""
    row = records + i * RECORD
    u, v = tl.load(row, mask=mask, other=0.0), tl.load(row + 1, mask=mask, other=0.0)
    sx = tl.load(row + 2, mask=mask, other=1.0)
    sy = tl.load(row + 3, mask=mask, other=0.0)
    ty = tl.load(row + 4, mask=mask, other=1.0)
    drop = tl.load(row + 5, mask=mask, other=0.0) - LOG2_ALPHA_MIN
    ex, ey = tl.load(row + 10, mask=mask, other=0.0), tl.load(row + 11, mask=mask, other=0.0)
    seen = ey > 0
    sx, ty = tl.where(seen, sx, 1.0), tl.where(seen, ty, 1.0)
    half = tl.sqrt(tl.maximum(drop, 0.0)) / sx
    return u, v, ex, ey, sx * sy / (sy * sy + ty * ty), -sy / sx, half, mask & seen


@triton.jit
@no_type_check
def _rows(v, ey, height, seen):
    """Return the first row of tiles that the ellipse touches, and the number of rows."""
    first = tl.maximum(tl.ceil(v - ey - RIM_SLACK), 0.0).to(tl.int32)
    last = tl.minimum(tl.floor(v + ey + RIM_SLACK), height - 1.0).to(tl.int32)
    return first // TILE, tl.where(seen & (first <= last), last // TILE - first // TILE + 1, 0)


@triton.jit
@no_type_check
def _columns(u, v, ex, ey, slant, tangent, half, ty, width):
    """Return the first column that the ellipse touches in a row of tiles, and the number of columns."""
    low, high = (ty * TILE).to(tl.float32) - v, (ty * TILE + TILE - 1).to(tl.float32) - v
    low, high = tl.maximum(low, -ey), tl.minimum(high, ey)
    middle = (low + high) / 2  # if only the slack touches the band
    met = low <= high
    low, high = tl.where(met, low, middle), tl.where(met, high, middle)
    right, left = (
        tl.minimum(tl.maximum(-slant * ex, low), high),
        tl.minimum(tl.maximum(slant * ex, low), high),
    )
    qr = tl.sqrt(tl.maximum(1 - (right / ey) * (right / ey), 0.0))
    ql = tl.sqrt(tl.maximum(1 - (left / ey) * (left / ey), 0.0))
    x1 = tl.floor(u + tangent * right + half * qr + RIM_SLACK)
    x0 = tl.ceil(u + tangent * left - half * ql - RIM_SLACK)
    c0 = tl.minimum(tl.maximum(x0, 0.0), width * 1.0).to(tl.int32)
    c1 = tl.maximum(tl.minimum(x1, width - 1.0), -1.0).to(tl.int32)
    return c0 // TILE, tl.where(c0 <= c1, c1 // TILE - c0 // TILE + 1, 0)


@triton.jit
@no_type_check
def seam_shift(left, u, width):
    """Return the whole turns, px, by which a mean at column u is nearest to the tile whose first column is `left`."""
    turn = width * 1.0
    return turn * tl.floor((left + 0.5 * (TILE - 1) - u) / turn + 0.5)


@triton.jit
@no_type_check
def _nearest_tiles(u, copy, width):
    """Return the first column of tiles to which a copy of the ellipse is the nearest, and the one after the last."""
    tiles_x = (width + TILE - 1) // TILE
    begin, end = 0 * u.to(tl.int32) + tiles_x, 0 * u.to(tl.int32)
    tx = 0
    while tx < tiles_x:
        here = seam_shift(tx * TILE, u, width) == copy * width
        begin, end = tl.where(here & (tx < begin), tx, begin), tl.where(here, tx + 1, end)
        tx += 1
    return begin, end


@triton.jit
@no_type_check
def _columns_of(copy, u, v, ex, ey, slant, tangent, half, ty, width, nearest, WRAPS: tl.constexpr):
    """Return the same as `_columns` for a copy of the ellipse."""
    if WRAPS:
        first, columns = _columns(u + copy * width, v, ex, ey, slant, tangent, half, ty, width)
        begin, end = tl.maximum(first, nearest[0]), tl.minimum(first + columns, nearest[1])
        first, columns = begin, tl.maximum(end - begin, 0)
    else:
        first, columns = _columns(u, v, ex, ey, slant, tangent, half, ty, width)
    return first, columns


@triton.jit
@no_type_check
def count_kernel(records, pairs_of, n, width, height, WRAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Count the tiles of each Gaussian of a block."""
    i = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    u, v, ex, ey, slant, tangent, half, seen = _ellipse(records, i, i < n)
    first, rows = _rows(v, ey, height, seen)
    ey = tl.where(seen, ey, 1.0)
    total = tl.zeros([BLOCK], tl.int32)
    for copy in tl.static_range(-1 if WRAPS else 0, 2 if WRAPS else 1):
        nearest = _nearest_tiles(u, copy, width) if WRAPS else (0, 0)
        k, most = 0, tl.max(rows, 0)
        while k < most:
            _, columns = _columns_of(
                copy, u, v, ex, ey, slant, tangent, half, first + k, width, nearest, WRAPS
            )
            total += tl.where(k < rows, columns, 0)
            k += 1
    tl.store(pairs_of + i, total, mask=i < n)


@triton.jit
@no_type_check
def emit_kernel(
    records, order, begin, pairs_of, tiles, gaussians, n, width, height, tiles_x,
    WRAPS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write tile and Gaussian of every pair, by Gaussian in the given order; never more than were counted."""
    k = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    mask = k < n
    i = tl.load(order + k, mask=mask, other=0)
    u, v, ex, ey, slant, tangent, half, seen = _ellipse(records, i, mask)
    first, rows = _rows(v, ey, height, seen)
    ey = tl.where(seen, ey, 1.0)
    place = tl.load(begin + i, mask=mask, other=0)
    end = place + tl.load(pairs_of + i, mask=mask, other=0)
    for copy in tl.static_range(-1 if WRAPS else 0, 2 if WRAPS else 1):
        nearest = _nearest_tiles(u, copy, width) if WRAPS else (0, 0)
        row, most_rows = 0, tl.max(rows, 0)
        while row < most_rows:
            tx, columns = _columns_of(
                copy, u, v, ex, ey, slant, tangent, half, first + row, width, nearest, WRAPS
            )
            columns = tl.where(row < rows, columns, 0)
            column, most_columns = 0, tl.max(columns, 0)
            while column < most_columns:
                here = mask & (column < columns) & (place + column < end)
                tl.store(tiles + place + column, (first + row) * tiles_x + tx + column, mask=here)
                tl.store(gaussians + place + column, i.to(tl.int32), mask=here)
                column += 1
            place += columns
            row += 1

"""composite: blend a tile's Gaussians into its pixels, near to far; backward in the same order.

    p = log2_o - s² - t²;   alpha = min(0.99, 2^p), 0 where p < log2(1/255);   w = T alpha;   image += w c;   T -= w

A program handles one tile and processes its pairs in batches, as a matrix of pixels by Gaussians. The transmittance T
before each Gaussian is a running product along the batch, and the colours are a matrix product. The backward pass uses
plain sums: exact matrix products would need more registers than available.

Chapter: 10_the_naive_kernel.
"""

from __future__ import annotations

import math
from typing import no_type_check

import triton
import triton.language as tl

from gsplat_edu.base import constants
from gsplat_edu.render.cuda.intersect import seam_shift
from gsplat_edu.render.cuda.project import RECORD, SLOT

TILE = tl.constexpr(constants.TILE)
PIXELS = tl.constexpr(constants.TILE * constants.TILE)
T_STOP = tl.constexpr(constants.T_STOP)
LOG2_ALPHA_MIN = tl.constexpr(math.log2(constants.ALPHA_MIN))
CHANNELS = tl.constexpr(16)
"""Columns of the channel matrices: red, green, blue, depth, and zero padding, the minimum for matrix units."""


@triton.jit
@no_type_check
def _pixels(tile, tiles_x, W, H):
    """Return columns and rows of a tile's pixels, and whether each lies in the image."""
    lane = tl.arange(0, PIXELS)
    x = tile % tiles_x * TILE + lane % TILE
    y = tile // tiles_x * TILE + lane // TILE
    return x, y, (x < W) & (y < H)


@triton.jit
@no_type_check
def _column_of_means(records, ids, mask, left, W, WRAPS: tl.constexpr):
    """Return the columns of means, px; in a panorama, nearest to the tile whose first column is `left`."""
    u = tl.load(records + ids.to(tl.int64) * RECORD, mask=mask, other=0.0)
    if WRAPS:
        u += seam_shift(left, u, W)
    return u


@triton.jit
@no_type_check
def _alphas(records, ids, mask, x, y, u, most):
    """Return p and alpha for every pair of pixel and Gaussian; `most` is the logarithm of alpha's clamp."""
    row = records + ids.to(tl.int64) * RECORD
    dx = x[:, None].to(tl.float32) - u[None, :]
    dy = y[:, None].to(tl.float32) - tl.load(row + 1, mask=mask, other=0.0)[None, :]
    sx, sy = tl.load(row + 2, mask=mask, other=0.0), tl.load(row + 3, mask=mask, other=0.0)
    ty, log2_o = tl.load(row + 4, mask=mask, other=0.0), tl.load(row + 5, mask=mask, other=-1000.0)
    s, t = sx[None, :] * dx + sy[None, :] * dy, ty[None, :] * dy
    p = log2_o[None, :] - s * s - t * t
    return p, tl.where(p >= LOG2_ALPHA_MIN, tl.exp2(tl.minimum(p, most)), 0.0)


@triton.jit
@no_type_check
def _weights(alpha, T):
    """Return T before each Gaussian, alpha (zero once all pixels of the tile are below 1e-4), and T after the batch."""
    after = T[:, None] * tl.cumprod(1 - alpha, axis=1)
    before = after / (1 - alpha)
    live = tl.max(before, axis=0) >= T_STOP
    alpha = tl.where(live[None, :], alpha, 0.0)
    return before, alpha, tl.min(tl.where(live[None, :], after, T[:, None]), axis=1)


@triton.jit
@no_type_check
def _channels(records, ids, mask):
    """Return red, green, blue and depth of the Gaussians as rows of a matrix."""
    column = tl.arange(0, CHANNELS)[None, :]
    place = tl.where(column < 4, column + 6, 0)  # red, green, blue and depth are at 6 to 9
    return tl.load(
        records + ids.to(tl.int64)[:, None] * RECORD + place, mask=mask[:, None] & (column < 4), other=0.0
    )


@triton.jit
@no_type_check
def composite_kernel(
    records, gaussians, tile_begin, background, image, transmittance, depth, median, W, H, tiles_x, most,
    WITH_DEPTH: tl.constexpr, WITH_MEDIAN: tl.constexpr, WRAPS: tl.constexpr, BATCH: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    """Composite one tile."""
    tile = tl.program_id(0)
    x, y, inside = _pixels(tile, tiles_x, W, H)
    k, end = tl.load(tile_begin + tile), tl.load(tile_begin + tile + 1)
    T = tl.where(inside, 1.0, 0.0)
    mixed = tl.zeros([PIXELS, CHANNELS], tl.float32)
    middle = tl.zeros([PIXELS], tl.float32)
    while (k < end) & (tl.max(T, axis=0) >= T_STOP):
        lane = k + tl.arange(0, BATCH)
        mask = lane < end
        ids = tl.load(gaussians + lane, mask=mask, other=0)
        u = _column_of_means(records, ids, mask, tile % tiles_x * TILE, W, WRAPS)
        _, alpha = _alphas(records, ids, mask, x, y, u, most)
        before, alpha, T = _weights(alpha, T)
        if WITH_MEDIAN:
            deep = tl.load(records + ids.to(tl.int64) * RECORD + 9, mask=mask, other=0.0)
            crosses = (before >= 0.5) & (before * (1 - alpha) < 0.5)
            middle += tl.sum(tl.where(crosses, deep[None, :], 0.0), axis=1)
        mixed += tl.dot(before * alpha, _channels(records, ids, mask), input_precision=PRECISION)
        k += BATCH
    column = tl.arange(0, CHANNELS)[None, :]
    behind = tl.load(background + column, mask=column < 3, other=0.0)
    mixed += T[:, None] * behind
    pixel = (y * W + x).to(tl.int64)
    tl.store(image + 3 * pixel[:, None] + column, mixed, mask=inside[:, None] & (column < 3))
    tl.store(transmittance + pixel, T, mask=inside)
    if WITH_DEPTH:
        deep = tl.sum(tl.where(column == 3, mixed, 0.0), axis=1)
        tl.store(depth + pixel, deep, mask=inside)
    if WITH_MEDIAN:
        tl.store(median + pixel, middle, mask=inside)


@triton.jit
@no_type_check
def _gradients(
    image,
    transmittance,
    depth,
    grad_image,
    grad_transmittance,
    grad_depth,
    pixel,
    inside,
    WITH_T: tl.constexpr,
    WITH_DEPTH: tl.constexpr,
):
    """Return the gradients of the channels as a matrix, and R = g . image + t T_final + gd depth at the end."""
    column = tl.arange(0, CHANNELS)[None, :]
    where = inside[:, None] & (column < 3)
    g = tl.load(grad_image + 3 * pixel[:, None] + column, mask=where, other=0.0)
    rest = tl.sum(g * tl.load(image + 3 * pixel[:, None] + column, mask=where, other=0.0), axis=1)
    if WITH_T:
        t = tl.load(transmittance + pixel, mask=inside, other=0.0)
        rest += t * tl.load(grad_transmittance + pixel, mask=inside, other=0.0)
    if WITH_DEPTH:
        gd = tl.load(grad_depth + pixel, mask=inside, other=0.0)
        rest += gd * tl.load(depth + pixel, mask=inside, other=0.0)
        g += tl.where(column == 3, gd[:, None], 0.0)
    return g, rest


@triton.jit
@no_type_check
def composite_backward_kernel(
    records, gaussians, perm, tile_begin, image, transmittance, depth,
    grad_image, grad_transmittance, grad_depth, slots, W, H, tiles_x, most,
    WITH_T: tl.constexpr, WITH_DEPTH: tl.constexpr, WRAPS: tl.constexpr, BATCH: tl.constexpr,
):  # fmt: skip
    """Write every pair's sums over one tile to its own slot; slots of pairs that were not drawn stay unchanged.

    cg = g . c;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   h = alpha dL/dalpha, 0 where alpha was clamped
    """
    tile = tl.program_id(0)
    x, y, inside = _pixels(tile, tiles_x, W, H)
    pixel = (y * W + x).to(tl.int64)
    g, rest = _gradients(
        image,
        transmittance,
        depth,
        grad_image,
        grad_transmittance,
        grad_depth,
        pixel,
        inside,
        WITH_T,
        WITH_DEPTH,
    )
    # Moments are computed about the tile's centre and shifted to each mean afterwards.
    x0, y0 = (
        (tile % tiles_x * TILE + TILE // 2).to(tl.float32),
        (tile // tiles_x * TILE + TILE // 2).to(tl.float32),
    )
    bx, by = x.to(tl.float32) - x0, y.to(tl.float32) - y0
    g0, g1, g2, g3 = _column(g, 0), _column(g, 1), _column(g, 2), _column(g, 3)
    k, end = tl.load(tile_begin + tile), tl.load(tile_begin + tile + 1)
    T = tl.where(inside, 1.0, 0.0)
    while (k < end) & (tl.max(T, axis=0) >= T_STOP):
        lane = k + tl.arange(0, BATCH)
        mask = lane < end
        ids = tl.load(gaussians + lane, mask=mask, other=0)
        u = _column_of_means(records, ids, mask, tile % tiles_x * TILE, W, WRAPS)
        p, alpha = _alphas(records, ids, mask, x, y, u, most)
        before, alpha, T = _weights(alpha, T)
        w = before * alpha
        row = records + ids.to(tl.int64) * RECORD
        cg = g0[:, None] * tl.load(row + 6, mask=mask, other=0.0)[None, :]
        cg += g1[:, None] * tl.load(row + 7, mask=mask, other=0.0)[None, :]
        cg += g2[:, None] * tl.load(row + 8, mask=mask, other=0.0)[None, :]
        if WITH_DEPTH:
            cg += g3[:, None] * tl.load(row + 9, mask=mask, other=0.0)[None, :]
        left = rest[:, None] - tl.cumsum(w * cg, axis=1)
        rest -= tl.sum(w * cg, axis=1)
        h = tl.where(p >= most, 0.0, alpha * (before * cg - left / (1 - alpha)))
        out = slots + tl.load(perm + lane, mask=mask, other=0) * SLOT
        tl.store(out, tl.sum(w * g0[:, None], axis=0), mask=mask)
        tl.store(out + 1, tl.sum(w * g1[:, None], axis=0), mask=mask)
        tl.store(out + 2, tl.sum(w * g2[:, None], axis=0), mask=mask)
        if WITH_DEPTH:
            tl.store(out + 3, tl.sum(w * g3[:, None], axis=0), mask=mask)
        v = tl.load(row + 1, mask=mask, other=0.0) - y0
        _store_moments(out, h, bx, by, u - x0, v, mask)
        k += BATCH


@triton.jit
@no_type_check
def _column(matrix, j: tl.constexpr):
    return tl.sum(tl.where(tl.arange(0, CHANNELS)[None, :] == j, matrix, 0.0), axis=1)


@triton.jit
@no_type_check
def _store_moments(out, h, x, y, u, v, mask):
    """Sum h and its moments about the tile's centre over the pixels, and store them about the means at (u, v)."""
    hx, hy = h * x[:, None], h * y[:, None]
    s, sx, sy = tl.sum(h, axis=0), tl.sum(hx, axis=0), tl.sum(hy, axis=0)
    sxx, sxy = tl.sum(hx * x[:, None], axis=0), tl.sum(hx * y[:, None], axis=0)
    syy = tl.sum(hy * y[:, None], axis=0)
    tl.store(out + 4, s, mask=mask)
    tl.store(out + 5, sx - u * s, mask=mask)
    tl.store(out + 6, sy - v * s, mask=mask)
    tl.store(out + 7, sxx - 2 * u * sx + u * u * s, mask=mask)
    tl.store(out + 8, sxy - u * sy - v * sx + u * v * s, mask=mask)
    tl.store(out + 9, syy - 2 * v * sy + v * v * s, mask=mask)

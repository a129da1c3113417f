"""The loss (1 - k) L1 + k (1 - SSIM) and its gradient, as Triton kernels.

With G a blur of 11 taps (sigma 1.5, zero outside the image), mx = G x, my = G y, v = G (x² + y²) - mx² - my² (the sum
of both variances), c = G xy - mx my, all per channel:

    S = A1 A2 / (B1 B2),  A1 = 2 mx my + C1,  A2 = 2 c + C2,  B1 = mx² + my² + C1,  B2 = v + C2
    dS/dv = -S / B2,  dS/dc = 2 A1 / (B1 B2),  dS/dmx = 2 my A2 / (B1 B2) - 2 mx S / B1 - 2 mx dS/dv - my dS/dc
    dsum(S)/dx = G dS/dmx + 2 x G dS/dv + y G dS/dc

G is separable, and a program sees only its own block of an array, so each direction of each blur is a kernel: four in
all, and a fifth that adds the sums of the blocks. An image is treated as H rows of 3 W values; the next tap to the
right is three values further. Without atomics, two runs give the same bits.
"""

from __future__ import annotations

import math
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float, UInt8
from torch import Tensor

from gsplat_edu.base import constants
from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import check_shape, in_range

# A block's rows are read again for every vertical tap: its 26 rows for 16 stay in the L1 cache.
ROWS = tl.constexpr(16)
COLUMNS = tl.constexpr(64)
LANES = tl.constexpr(1024)
"""Number of block sums added at a time."""
WARPS = 16
"""Warps per block. With 4, a thread's eight values and their taps would need more registers than available."""

CHANNELS = tl.constexpr(3)
HALF = tl.constexpr(5)
"""Taps on each side of the centre."""

_FALL = math.exp(-0.5 / constants.SSIM_SIGMA**2)
FALL = tl.constexpr(_FALL)
"""The tap at distance k from the centre has weight PEAK FALL^(k²)."""
PEAK = tl.constexpr(1.0 / sum(_FALL ** (k * k) for k in range(-5, 6)))
C1 = tl.constexpr(constants.SSIM_C1)
C2 = tl.constexpr(constants.SSIM_C2)


@triton.jit
@no_type_check
def _block(size):
    """Return this program's rows and columns, their offsets in an array (H, 3 W), and which are inside it."""
    height, width = size
    top = tl.program_id(1) * ROWS
    row = top + tl.arange(0, ROWS)[:, None]
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    # 64 bits for offsets that grow with the image, 32 for those within the block.
    place = top.to(tl.int64) * (width * CHANNELS) + (
        tl.arange(0, ROWS)[:, None] * (width * CHANNELS) + column
    )
    return row, column, place, (row < height) & (column < width * CHANNELS)


@triton.jit
@no_type_check
def _blur(array, at, length, stride, inside):
    """Blur along one axis: `at` is a lane's position on it, below `length`; neighbours are `stride` values apart."""
    total = tl.load(array, mask=inside, other=0.0) * PEAK
    for k in tl.static_range(1, HALF + 1):
        before = tl.load(array - k * stride, mask=inside & (at >= k), other=0.0)
        after = tl.load(array + k * stride, mask=inside & (at + k < length), other=0.0)
        total += (before + after) * (PEAK * FALL ** (k * k))
    return total


@triton.jit
@no_type_check
def _pair(image, target, place, scale, inside):
    """Load x and y; the target may be bytes or floats."""
    x = tl.load(image + place, mask=inside, other=0.0)
    return x, tl.load(target + place, mask=inside, other=0).to(tl.float32) * scale


@triton.jit
@no_type_check
def moments_kernel(image, target, planes, size, scale):
    """Blur x, y, x² + y² and xy along the rows, into four planes."""
    height, width = size
    _, column, place, inside = _block(size)
    pixel = column // CHANNELS
    x, y = _pair(image, target, place, scale, inside)
    mx, my, squares, product = x * PEAK, y * PEAK, (x * x + y * y) * PEAK, (x * y) * PEAK
    for k in tl.static_range(1, HALF + 1):
        weight = PEAK * FALL ** (k * k)
        x0, y0 = _pair(image, target, place - CHANNELS * k, scale, inside & (pixel >= k))
        x1, y1 = _pair(image, target, place + CHANNELS * k, scale, inside & (pixel + k < width))
        mx += (x0 + x1) * weight
        my += (y0 + y1) * weight
        squares += (x0 * x0 + x1 * x1 + y0 * y0 + y1 * y1) * weight
        product += (x0 * y0 + x1 * y1) * weight
    plane = (width * CHANNELS).to(tl.int64) * height
    tl.store(planes + place, mx, mask=inside)
    tl.store(planes + plane + place, my, mask=inside)
    tl.store(planes + 2 * plane + place, squares, mask=inside)
    tl.store(planes + 3 * plane + place, product, mask=inside)


@triton.jit
@no_type_check
def similarity_kernel(planes, maps, sums, size, each):
    """Blur the moments down the columns; write dS/dmx, dS/dv and dS/dc, and the block's sum of `each` (1 - S)."""
    height, width = size
    row, _, place, inside = _block(size)
    stride = width * CHANNELS
    plane = stride.to(tl.int64) * height
    mx = _blur(planes + place, row, height, stride, inside)
    my = _blur(planes + plane + place, row, height, stride, inside)
    v = _blur(planes + 2 * plane + place, row, height, stride, inside) - mx * mx - my * my
    c = _blur(planes + 3 * plane + place, row, height, stride, inside) - mx * my
    A1, A2, B1, B2 = 2 * mx * my + C1, 2 * c + C2, mx * mx + my * my + C1, v + C2
    inverse = 1.0 / (B1 * B2)
    S = A1 * A2 * inverse
    dv, dc = -S * B1 * inverse, 2 * A1 * inverse
    dm = 2 * inverse * (my * A2 - mx * S * B2) - 2 * mx * dv - my * dc
    tl.store(maps + place, dm, mask=inside)
    tl.store(maps + plane + place, dv, mask=inside)
    tl.store(maps + 2 * plane + place, dc, mask=inside)
    lost = tl.where(inside, 1.0 - S, 0.0)
    tl.store(sums + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0), each * tl.sum(lost))


@triton.jit
@no_type_check
def maps_kernel(maps, planes, size):
    """Blur the three maps along the rows, into the first three planes."""
    height, width = size
    _, column, place, inside = _block(size)
    plane = (width * CHANNELS).to(tl.int64) * height
    for i in tl.static_range(3):
        blurred = _blur(maps + i * plane + place, column // CHANNELS, width, CHANNELS, inside)
        tl.store(planes + i * plane + place, blurred, mask=inside)


@triton.jit
@no_type_check
def gradient_kernel(image, target, planes, gradient, sums, size, numbers):
    """Write the loss's gradient and the block's sum of l1 |x - y|; without planes, the loss is L1 only."""
    height, width = size
    scale, l1, ssim = numbers
    row, _, place, inside = _block(size)
    x, y = _pair(image, target, place, scale, inside)
    slope = tl.where(x > y, l1, 0.0) - tl.where(x < y, l1, 0.0)
    if planes is not None:
        stride = width * CHANNELS
        plane = stride.to(tl.int64) * height
        dm = _blur(planes + place, row, height, stride, inside)
        dv = _blur(planes + plane + place, row, height, stride, inside)
        dc = _blur(planes + 2 * plane + place, row, height, stride, inside)
        slope -= ssim * (dm + 2 * x * dv + y * dc)
    tl.store(gradient + place, slope, mask=inside)
    away = tl.where(inside, tl.abs(x - y), 0.0)
    tl.store(sums + tl.program_id(1) * tl.num_programs(0) + tl.program_id(0), l1 * tl.sum(away))


@triton.jit
@no_type_check
def add_kernel(sums, count, total):
    """Add all sums in one program: each lane adds its own in order, then the lanes are added."""
    lane = tl.arange(0, LANES)
    partial = tl.zeros([LANES], tl.float32)
    start = 0
    while start < count:
        partial += tl.load(sums + start + lane, mask=start + lane < count, other=0.0)
        start += LANES
    tl.store(total, tl.sum(partial))


def l1_ssim_triton(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"],
    ssim_weight: float = 0.2,
) -> Float[Tensor, ""]:
    """Return the loss (1 - k) L1 + k (1 - SSIM), computed together with its gradient.

    SSIM is the mean over pixels and channels of (2 mx my + C1)(2 c + C2) / ((mx² + my² + C1)(v + C2)), with means,
    covariance c and sum of variances v under a Gaussian window of 11 taps (sigma 1.5), zero outside the image. The
    function does not synchronise with the device.

    Args:
        image: (H, W, 3) render, float32.
        target: (H, W, 3) photo, 0 to 1, float32; or uint8, 0 to 255; receives no gradient.
        ssim_weight: k, 0 to 1; 0 skips the blurs.

    Returns:
        () scalar, differentiable in the image; NaN for an image without pixels.

    Raises:
        ShapeError: the image is not (H, W, 3), or the target's size differs.
        ArgumentError: a dtype is unsupported, the devices differ, or the weight is outside 0 to 1.

    Source: Kerbl et al. 2023, eq. 7; Wang et al. 2004.
    """
    check_shape("image", image.shape, ("H", "W", 3), {})
    check_shape("target", target.shape, image.shape, {})
    if image.dtype != torch.float32:
        raise ArgumentError(f"image: is {image.dtype}, but has to be float32")
    if target.dtype not in (torch.float32, torch.uint8) or target.device != image.device:
        raise ArgumentError(
            f"target: is {target.dtype} on {target.device}, but has to be float32 or uint8 on {image.device}"
        )
    weight = in_range("ssim_weight", ssim_weight, 0.0, 1.0)
    loss: Tensor = _L1Ssim.apply(image, target, weight)  # type: ignore[no-untyped-call]
    return loss


@first_derivative_only("l1_ssim", 'l1_ssim_in_torch, the loss of backend="torch"')
class _L1Ssim(torch.autograd.Function):
    """Compute loss and gradient together; backward only scales."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:  # noqa: ANN401
        x, y = image.detach().contiguous(), target.detach().contiguous()
        gradient = torch.empty_like(x)
        ctx.save_for_backward(gradient)
        if not x.numel():
            return x.new_full((), math.nan)
        return _loss_and_gradient(x, y, gradient, ssim_weight)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401
        (gradient,) = ctx.saved_tensors
        # Even if it is 1: checking would synchronise with the device.
        return gradient * grad, None, None


def _loss_and_gradient(x: Tensor, y: Tensor, gradient: Tensor, ssim_weight: float) -> Tensor:
    """Write the gradient and return the loss: sum over blocks of (1 - k)/n |x - y| + k/n (1 - S), n = 3 H W."""
    height, width, n = x.shape[0], x.shape[1], x.numel()
    size = (height, width)
    grid = (triton.cdiv(3 * width, COLUMNS.value), triton.cdiv(height, ROWS.value))
    blocks = grid[0] * grid[1]
    scale = 1.0 / 255.0 if y.dtype == torch.uint8 else 1.0
    numbers = (scale, (1.0 - ssim_weight) / n, ssim_weight / n)
    sums = x.new_empty(2 * blocks if ssim_weight else blocks)
    planes = None
    if ssim_weight:
        planes, maps = x.new_empty(4, *x.shape), x.new_empty(3, *x.shape)
        moments_kernel[grid](x, y, planes, size, scale, num_warps=WARPS)
        similarity_kernel[grid](planes, maps, sums[blocks:], size, numbers[2], num_warps=WARPS)
        maps_kernel[grid](maps, planes, size, num_warps=WARPS)
    gradient_kernel[grid](x, y, planes, gradient, sums, size, numbers, num_warps=WARPS)
    total = x.new_empty(())
    add_kernel[(1,)](sums, sums.numel(), total)
    return total

"""Exposure and white balance of a photo relative to an image: one gain per channel.

y = g x + 0.055 (g - 1) for every channel, with g = s^(1/2.4)

Exposure and white balance scale linear light by s. Above its short linear start, the sRGB curve is
1.055 l^(1/2.4) - 0.055, so on encoded colours the scale is this line, exactly. As a matrix (3, 4) of colours it has
the three gains on its diagonal; see `gsplat_edu.recolor`.

Source of the curve: IEC 61966-2-1.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from gsplat_edu.threads import one_thread
from gsplat_edu.validation import check_shape

SRGB_POWER = 2.4
"""Exponent of the sRGB curve."""

SRGB_OFFSET = 0.055
"""Its offset, of encoded colours."""

SAMPLES = 1 << 12
"""Pixels on a grid that a gain is measured at. Where ratios scatter by a tenth, their median is good to 0.2 %."""

FEWEST = 64
"""A gain from fewer pixels than this counts as 1."""

DARKEST, BRIGHTEST = 2.0 / 255.0, 253.0 / 255.0
"""Pixels of the photo outside this range may be clipped and do not count."""


def measured_gains(
    image: Float[Tensor, "H W 3"],
    photo: UInt8[Tensor, "H W 3"] | Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> Float[Tensor, "3"]:
    """Return the natural logarithm of each channel's gain from an image to a photo of the same scene.

    The median over pixels of log((y + 0.055) / (x + 0.055)). Unlike the mean, it ignores dark gaps of an
    unfinished scene.

    Args:
        image: (H, W, 3) render; values below 0 count as 0.
        photo: (H, W, 3) uint8, or float from 0 to 1. Pixels with a clipped channel do not count.
        mask: (H, W) true for pixels that count; None if all do.

    Returns:
        (3,) of the image's dtype, on its device; 0 if too few pixels count.

    Raises:
        ShapeError: the sizes differ.
    """
    check_shape("image", image.shape, ("H", "W", 3), {})
    check_shape("photo", photo.shape, image.shape, {})
    step = max(1, math.isqrt(image.shape[0] * image.shape[1] // SAMPLES))
    x, y = (every[::step, ::step].reshape(-1, 3).double() for every in (image.detach(), photo))
    with one_thread():
        if photo.dtype == torch.uint8:
            y = y / 255.0
        counts = ((y >= DARKEST) & (y <= BRIGHTEST)).all(dim=1) & torch.isfinite(x).all(dim=1)
        if mask is not None:
            check_shape("mask", mask.shape, image.shape[:2], {})
            counts &= mask[::step, ::step].reshape(-1)
        if int(counts.sum()) < FEWEST:
            return image.new_zeros(3)
        ratios = (y[counts] + SRGB_OFFSET) / (x[counts].clamp_min(0.0) + SRGB_OFFSET)
        medians = torch.stack([channel.contiguous().median() for channel in ratios.unbind(dim=1)])
        return torch.log(medians).to(image.dtype)


def color_matrix(log_gains: Float[Tensor, "*views 3"]) -> Float[Tensor, "*views 3 4"]:
    """Return the matrices (3, 4) that apply gains, given by their natural logarithm."""
    with one_thread():
        gains = torch.exp(log_gains)
        return torch.cat([torch.diag_embed(gains), SRGB_OFFSET * (gains - 1)[..., None]], dim=-1)


def stops(log_gains: Float[Tensor, "*views 3"]) -> Float[Tensor, "*views 3"]:
    """Return gains in stops of light, the base-2 logarithm of s = g^2.4."""
    return log_gains * (SRGB_POWER / math.log(2.0))

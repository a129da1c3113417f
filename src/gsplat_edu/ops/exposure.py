"""Exposure and white balance of a photo relative to an image: one gain per channel.

y = g x + 0.055 (g - 1) for every channel, with g = s^(1/2.4)

Exposure and white balance scale linear light by s. Above its short linear start, the sRGB curve is
1.055 l^(1/2.4) - 0.055, so on encoded colours the scale is this line, exactly. As a matrix (3, 4) of colours it has
the three gains on its diagonal; see `gsplat_edu.ops.recolor`. Vignetting scales light likewise, by a factor that
depends on the distance from the photo's centre.

Source of the curve: IEC 61966-2-1.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from gsplat_edu.base.constants import SRGB_OFFSET
from gsplat_edu.base.threads import one_thread
from gsplat_edu.base.validation import check_shape

SRGB_POWER = 2.4
"""Exponent of the sRGB curve."""

SAMPLES = 1 << 12
"""Approximate number of grid pixels at which a gain is measured. If ratios scatter by 10 %, their median is accurate to
0.2 %."""

FEWEST = 64
"""A gain is 1 if fewer pixels count."""

INNER, OUTER = -0.13, 0.11
"""Vignetting is measured between pixels with q < INNER and pixels with q > OUTER, a third of a 4:3 photo each."""

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
    found = _ratios(image, photo, mask)
    if found is None:
        return image.new_zeros(3)
    with one_thread():
        return torch.log(_medians(found[0])).to(image.dtype)


def measured_vignetting(
    image: Float[Tensor, "H W 3"],
    photo: UInt8[Tensor, "H W 3"] | Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> Float[Tensor, "4"]:
    """Return the logarithm of each channel's gain as `measured_gains` does, and k of the vignetting, see `falloff`.

    k is the slope of a resistant line, between the medians of about the outermost and the innermost third of the
    pixels; 0 if too few of them count.

    Arguments and errors are those of `measured_gains`.
    """
    found = _ratios(image, photo, mask)
    if found is None:
        return image.new_zeros(4)
    ratios, counts, step = found
    rows, columns = _squared_distances(image.shape[0], image.shape[1], step, ratios)
    with one_thread():
        distances, logs = (rows[:, None] + columns).reshape(-1)[counts], torch.log(ratios)
        inner, outer = distances < INNER, distances > OUTER
        slope = distances.new_zeros(())
        if min(int(inner.sum()), int(outer.sum())) >= FEWEST:
            level = logs.mean(dim=1)
            rise = level[outer].median() - level[inner].median()
            slope = rise / (distances[outer].mean() - distances[inner].mean())
        return torch.cat([_medians(logs - slope * distances[:, None]), slope[None]]).to(image.dtype)


def falloff(k: Float[Tensor, ""], height: int, width: int) -> Float[Tensor, "H W"]:
    """Return the vignetting of a photo, exp(k q), whose geometric mean over the pixels is 1.

    q is the squared distance from the photo's centre, 1 at the corners, minus its mean over the pixels.

    Args:
        k: Logarithm of the gain in the corners against that in the centre; negative where corners are darker.
        height: H, px.
        width: W, px.

    Returns:
        (H, W) factors for `gsplat_edu.ops.recolor.recolored`.
    """
    rows, columns = _squared_distances(height, width, 1, k)
    with one_thread():
        return torch.exp(k * rows)[:, None] * torch.exp(k * columns)


def _squared_distances(
    height: int, width: int, step: int, like: Tensor
) -> tuple[Float[Tensor, " h"], Float[Tensor, " w"]]:
    """Return the parts of q that belong to each row and to each column of a grid of pixels; q is their sum."""
    unit = (height * height + width * width) / 4.0
    parts = []
    with one_thread():
        for side in (height, width):
            place = torch.arange(0, side, step, dtype=torch.float64) - (side - 1) / 2.0
            parts.append(((place * place - (side * side - 1) / 12.0) / unit).to(like))
    return parts[0], parts[1]


def _ratios(
    image: Tensor, photo: Tensor, mask: Tensor | None
) -> tuple[Float64[Tensor, "n 3"], Bool[Tensor, " pixels"], int] | None:
    """Return (y + 0.055) / (x + 0.055), which pixels of a grid count, and the grid's step; None if too few count."""
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
            return None
        return (y[counts] + SRGB_OFFSET) / (x[counts].clamp_min(0.0) + SRGB_OFFSET), counts, step


def _medians(values: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    return torch.stack([channel.contiguous().median() for channel in values.unbind(dim=1)])


def color_matrix(log_gains: Float[Tensor, "*views 3"]) -> Float[Tensor, "*views 3 4"]:
    """Return the matrices (3, 4) that apply gains, given by their natural logarithm."""
    with one_thread():
        gains = torch.exp(log_gains)
        return torch.cat([torch.diag_embed(gains), SRGB_OFFSET * (gains - 1)[..., None]], dim=-1)


def stops(log_gains: Float[Tensor, "*views 3"]) -> Float[Tensor, "*views 3"]:
    """Return gains in stops of light, the base-2 logarithm of s = g^2.4."""
    return log_gains * (SRGB_POWER / math.log(2.0))

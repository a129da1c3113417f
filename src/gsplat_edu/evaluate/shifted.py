"""Image quality of details that are sharp but out of place.

PSNR compares each pixel with the one in its place, so it scores a sharp picture whose details are some pixels off below
a blurred one. Cameras that are wrong by some pixels cause that, and no training can mend it. Here the surroundings of
each pixel may move.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, check_shape, float64_array
from gsplat_edu.evaluate.metrics import MSE_FLOOR

SHIFT = 1 / 60
"""How far surroundings may move to each side, in units of the image's longer side."""

WINDOW = 7
"""Side of the square that moves as one, px. It is odd."""


def psnr_shifted(image: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return the PSNR of a render whose details may be out of place.

    The error of a pixel is the mean squared error in the `WINDOW` around it, least over all shifts of the render by
    whole pixels up to `SHIFT`, at least by one pixel. Beyond its edges the render continues with the colours there.

    Args:
        image: (H, W, 3) render, uint8, or float from 0 to 1.
        truth: (H, W, 3) photo, uint8, or float from 0 to 1.
        mask: (H, W) true for the pixels of the photo that count; None counts all.

    Returns:
        dB; 100 for equal images.

    Raises:
        ShapeError: the sizes of the arguments differ.
        ArgumentError: a value is NaN or infinite, or the mask excludes all pixels.
    """
    sizes: dict[str, int] = {}
    render, photo = _unit("image", image, sizes), _unit("truth", truth, sizes)
    height, width = photo.shape[:2]
    counts = np.ones((height, width)) if mask is None else np.asarray(mask).astype(np.float64)
    check_shape("mask", counts.shape, ("H", "W"), sizes)
    if not counts.any():
        raise ArgumentError("mask: no pixel counts; leave the image out")
    reach = max(round(SHIFT * max(height, width)), 1)
    wide = np.pad(render, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    near = np.maximum(_window_sums(counts), 1.0)
    least = np.full((height, width), np.inf)
    for down in range(2 * reach + 1):
        for across in range(2 * reach + 1):
            moved = wide[down : down + height, across : across + width]
            errors = np.square(moved - photo).mean(axis=2) * counts
            least = np.minimum(least, _window_sums(errors) / near)
    error = float(least[counts > 0].mean())
    return -10.0 * math.log10(max(error, MSE_FLOOR))


def _unit(name: str, image: ArrayLike, sizes: dict[str, int]) -> Float64[np.ndarray, "H W 3"]:
    """Return an image in float64, from 0 to 1."""
    values = float64_array(name, image, ("H", "W", 3), sizes)
    return values / 255.0 if np.asarray(image).dtype == np.uint8 else np.clip(values, 0.0, 1.0)


def _window_sums(values: Float64[np.ndarray, "H W"]) -> Float64[np.ndarray, "H W"]:
    """Return the sums over the window around each pixel; outside the image there is nothing."""
    half = WINDOW // 2
    padded = np.pad(values, half)
    for axis in (0, 1):
        padded = np.lib.stride_tricks.sliding_window_view(padded, WINDOW, axis).sum(axis=-1)
    return padded

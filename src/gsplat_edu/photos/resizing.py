"""Downscale photos with alpha and masks: every small pixel is the mean of the area it covers."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, UInt8

ALL_OF_IT = 0.9999
"""A downscaled pixel counts if at least this fraction of its area counts: all, up to float32 rounding."""


def area_mean(
    pixels: UInt8[np.ndarray, "H W c"] | Float32[np.ndarray, "H W c"], W: int, H: int
) -> UInt8[np.ndarray, "h w c"] | Float32[np.ndarray, "h w c"]:
    """Return an image at another size, of the same dtype; each pixel is the mean of the area it covers.

    Args:
        pixels: (H, W, c) image.
        W: New width, px; not larger than the image's.
        H: New height, px; not larger than the image's.
    """
    if pixels.shape[:2] == (H, W):
        return pixels
    import cv2  # here, because the command line's options import views, and OpenCV takes long to import

    return np.asarray(cv2.resize(pixels, (W, H), interpolation=cv2.INTER_AREA))


def premultiplied(
    image: UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"], alpha: UInt8[np.ndarray, "H W"]
) -> Float32[np.ndarray, "H W 4"]:
    """Return colour times alpha, and alpha, both up to 255; transparent pixels have no colour to average.

    Args:
        image: (H, W, 3) colour, up to 255.
        alpha: (H, W) opacity, up to 255.
    """
    share = alpha[..., None].astype(np.float32) / 255.0
    return np.concatenate([image * share, 255.0 * share], axis=2, dtype=np.float32)


def unweighted(
    weighted: Float32[np.ndarray, "h w 4"],
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Convert colour times alpha, and alpha, both up to 255, to 8-bit colour and alpha."""
    color = weighted[..., :3] / np.maximum(weighted[..., 3:] / 255.0, 1e-6)
    return (
        np.clip(np.round(color), 0, 255).astype(np.uint8),
        np.clip(np.round(weighted[..., 3]), 0, 255).astype(np.uint8),
    )


def smaller_mask(mask: Bool[np.ndarray, "H W"], W: int, H: int) -> Bool[np.ndarray, "h w"]:
    """Return a mask at another size: a pixel counts if all of its area does."""
    if mask.shape == (H, W):
        return mask
    import cv2

    shares = cv2.resize(mask.astype(np.float32), (W, H), interpolation=cv2.INTER_AREA)
    counts: Bool[np.ndarray, "h w"] = shares >= ALL_OF_IT
    return counts


def eroded(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Return a mask without its pixels that touch a pixel outside the mask; the image's border erodes nothing."""
    import cv2

    kept: Bool[np.ndarray, "H W"] = cv2.erode(mask.view(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)
    return kept

"""Photos as the doctor looks at them: decoded small, measured once, and only a thumbnail kept."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from gsplat_edu.data.images import decode, decode_mask, image_size
from gsplat_edu.data.lens import Lens, undistortion
from gsplat_edu.image_files import UNDECODABLE, opened_image
from gsplat_edu.views import Photo

WORK_SIDE = 1024
"""Longest side of a photo while its sharpness is measured, px: blur that is gone at this size costs a scene little, and
photos of one subject by different cameras become comparable."""

THUMBNAIL_SIDE = 128
"""Longest side of what is kept of a photo, px: 50 kB, so that thousands fit into memory."""

JPEG_ONLY = 64_000_000
"""JPEGs up to so many pixels are decoded at a half, a quarter or an eighth of their size; Pillow warns of larger ones
before it has been told to."""

FINE, COARSE = 1.0, 4.0
"""Standard deviations at which gradients are taken, px of a photo of 1024. A step loses energy as 1 / sigma; a blur of
b px leaves sqrt((16 + b²) / (1 + b²)) as the ratio of the two, 4 where there is none, whatever the step's height."""

ANGLES = np.arange(8) * math.pi / 8
"""Directions along which gradients are taken, radians: shaking the camera blurs along one of them only."""

FLAT = 1e-2
"""Energy that is added to both scales, grey levels² per px²: below it there is nothing but rounding."""

GAMMA = 2.2
"""Bytes are about proportional to light to the power of 1 / 2.2."""

DARK, BRIGHT = 8.0, 247.0
"""Values of bytes outside of which a colour counts as clipped: ratios mean nothing there."""


@dataclass(frozen=True, eq=False)
class Look:
    """What is kept of a photo.

    Args:
        thumbnail: (h, w, 3) RGB, undistorted, at most 128 px long.
        detail: (8,) natural logarithm of the energy of fine gradients over that of coarse ones, by direction.
    """

    thumbnail: UInt8[np.ndarray, "h w 3"]
    detail: Float64[np.ndarray, "8"]


def look_at_photo(path: Path, lens: Lens, mask: Path | None = None) -> Look:
    """Decode a photo and measure it.

    Args:
        path: The image file.
        lens: The camera that took it, at the file's size.
        mask: Its mask; it is decoded too, because training would.

    Raises:
        DatasetError: the photo or its mask cannot be decoded, or the lens cannot be straightened.
    """
    if mask is not None:
        decode_mask(mask)
    pixels = _shrunk(_decoded(path), WORK_SIDE)
    small = _shrunk(pixels, THUMBNAIL_SIDE)
    h, w = small.shape[:2]
    if lens.distorts and min(h, w) > 1:
        columns, rows, _ = undistortion(lens.scaled(w, h), slice(0, h))
        small = cv2.remap(small, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return Look(np.asarray(small, dtype=np.uint8), detail_of(pixels))


def detail_of(pixels: UInt8[np.ndarray, "H W 3"]) -> Float64[np.ndarray, "8"]:
    """Measure how much fine detail a photo has for the coarse detail it has.

    Args:
        pixels: (H, W, 3) RGB.

    Returns:
        ln (E_fine + c) / (E_coarse + c) for each of eight directions, E the mean squared slope of the grey image
        along it, after smoothing.
    """
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = _energy(gray, FINE), _energy(gray, COARSE)
    return np.log((fine + FLAT) / (coarse + FLAT))


def _energy(gray: Float32[np.ndarray, "H W"], sigma: float) -> Float64[np.ndarray, "8"]:
    """Return the mean squared slope along each direction: c² xx + 2 c s xy + s² yy of the structure tensor."""
    smooth = cv2.GaussianBlur(gray, (0, 0), sigma)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    xx, yy, xy = (float(np.mean(a * b, dtype=np.float64)) for a, b in ((gx, gx), (gy, gy), (gx, gy)))
    c, s = np.cos(ANGLES), np.sin(ANGLES)
    return np.asarray(c * c * xx + s * s * yy + 2.0 * c * s * xy)


def _decoded(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Decode a photo, JPEGs at no more than twice the working size or a half; transparent ones over black.

    Pillow decodes, as for training: what it cannot read here it cannot read there.
    """
    W, H = image_size(path)
    if path.suffix.lower() in (".jpg", ".jpeg") and W * H <= JPEG_ONLY:
        try:
            with opened_image(path) as file:
                if file.format == "JPEG":
                    file.draft("RGB", (WORK_SIDE, WORK_SIDE))
                    return np.array(file.convert("RGB"))
        except UNDECODABLE:
            pass  # `decode` tells what is wrong with it
    image, alpha = decode(path)
    return image if alpha is None else np.asarray(Photo(image, alpha).over((0.0, 0.0, 0.0)))


def _shrunk(pixels: UInt8[np.ndarray, "H W 3"], side: int) -> UInt8[np.ndarray, "h w 3"]:
    H, W = pixels.shape[:2]
    share = side / max(H, W)
    if share >= 1.0:
        return pixels
    size = max(1, round(W * share)), max(1, round(H * share))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))

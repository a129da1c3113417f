"""Decode each photo at a reduced size, measure it once, and keep only a thumbnail."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from gsplat_edu.data.images import PhotoFile
from gsplat_edu.data.lens import undistortion
from gsplat_edu.data.panorama import FaceLens, cut_face, face_side
from gsplat_edu.photos.decoding import decode, decode_mask
from gsplat_edu.scene.photo import Photo, resized_mask, shrunk

WORK_SIDE = 1024
"""Longest side at which sharpness is measured, px. Blur that is invisible at this size hardly harms a scene, and photos
from different cameras become comparable."""

THUMBNAIL_SIDE = 128
"""Longest side of the thumbnail that is kept, px: 50 kB, so that thousands fit into memory."""

JPEG_ONLY = 64_000_000
"""JPEGs up to this many pixels are decoded at 1/2, 1/4 or 1/8 of their size. For larger ones Pillow warns before the
reduced size can be requested."""

FINE, COARSE = 1.0, 4.0
"""Sigmas of the Gaussians before gradients are taken, px of a photo of 1024 px. The energy of a step edge falls as
1 / sigma. A blur of b px makes their ratio sqrt((16 + b²) / (1 + b²)), 4 without blur, at any step height."""

ANGLES = np.arange(8) * math.pi / 8
"""Directions of the gradients, radians: camera shake blurs along one of them only."""

EDGE = 3.0
"""Detail is measured this many `COARSE` inside of a cut-out, where smoothing hardly reaches its edge."""

FLAT = 1e-2
"""Added to the energy of both scales, grey levels² per px²: smaller energies are rounding error."""

GAMMA = 2.2
"""Pixel values are roughly proportional to light^(1 / 2.2)."""

DARK, BRIGHT = 8.0, 247.0
"""Pixel values outside this range count as clipped: their ratios are meaningless."""


@dataclass(frozen=True, eq=False)
class PhotoStats:
    """Thumbnail and measurements of a photo.

    Args:
        thumbnail: (h, w, 3) RGB, undistorted, at most 128 px long.
        detail: (8,) natural logarithm of the energy of fine gradients over that of coarse ones, by direction; zero if
            it was not measured.
        transparent: Whether a pixel is not opaque.
        mask: (mh, mw) true for pixels of which more than half counts, as stored; None if the photo has no mask.
        counts: (h, w) true for the thumbnail's pixels that are opaque and inside the mask; None if all are.
        share: Share of the photo's pixels in which the detail was measured.
    """

    thumbnail: UInt8[np.ndarray, "h w 3"]
    detail: Float64[np.ndarray, "8"]
    transparent: bool = False
    mask: Bool[np.ndarray, "mh mw"] | None = None
    counts: Bool[np.ndarray, "h w"] | None = None
    share: float = 1.0

    @property
    def masked(self) -> bool:
        """Whether the photo has a mask."""
        return self.mask is not None


def unmeasured() -> PhotoStats:
    """Return what stands for the measurements of a photo that is not decoded."""
    return PhotoStats(np.zeros((1, 1, 3), dtype=np.uint8), np.zeros(len(ANGLES)))


def measure_photo(source: PhotoFile, sharpness: bool = True) -> PhotoStats:
    """Decode a photo and measure it.

    Args:
        source: The photo at its full size. Its mask is measured as stored, without undistortion.
        sharpness: Measure the detail too; without it, JPEGs are decoded at a smaller size.

    Raises:
        DatasetError: the photo or its mask cannot be decoded, or the lens cannot be undistorted.
    """
    lens = source.lens
    stored = None if source.mask is None else decode_mask(source.mask)
    mask = None if stored is None else _shrunk_mask(stored)
    decoded, alpha = _decoded(source, WORK_SIDE if sharpness else 2 * THUMBNAIL_SIDE)
    pixels = shrunk(decoded, WORK_SIDE)
    counts = _counting(alpha, stored, pixels.shape[:2])
    if face := isinstance(lens, FaceLens):
        pixels, _, counts = cut_face(pixels, None, counts, lens.R, face_side(pixels.shape[1]))
    small = shrunk(pixels, THUMBNAIL_SIDE)
    few = None if counts is None else resized_mask(counts, *small.shape[:2])
    h, w = small.shape[:2]
    if lens.distorts and not face and min(h, w) > 1:
        columns, rows, _ = undistortion(lens.scaled(w, h), slice(0, h))
        small = cv2.remap(small, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if few is not None:
            turned = cv2.remap(
                few.view(np.uint8), columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
            )
            few = turned.astype(np.bool_)
    inner = _inner(counts)
    detail = detail_of(pixels, inner) if sharpness else np.zeros(len(ANGLES))
    share = 1.0 if inner is None else float(inner.mean())
    shown = bool((alpha < 255).any()) if alpha is not None else False
    return PhotoStats(np.asarray(small, dtype=np.uint8), detail, shown, mask, few, share)


def _counting(
    alpha: UInt8[np.ndarray, "H W"] | None, mask: Bool[np.ndarray, "h w"] | None, shape: tuple[int, ...]
) -> Bool[np.ndarray, "a b"] | None:
    """Return the pixels that are opaque and inside the mask, at another size; None if all are."""
    parts = [part for part in (None if alpha is None else alpha == 255, mask) if part is not None]
    parts = [resized_mask(part, *shape) for part in parts if not part.all()]
    return np.logical_and.reduce(parts) if parts else None


def _inner(counts: Bool[np.ndarray, "H W"] | None) -> Bool[np.ndarray, "H W"] | None:
    """Return the pixels in which gradients count: away from the edge of a cut-out, which is always sharp."""
    if counts is None:
        return None
    side = 2 * math.ceil(EDGE * COARSE) + 1
    inner = cv2.erode(counts.view(np.uint8), np.ones((side, side), np.uint8)).astype(np.bool_)
    return np.asarray(inner)


def detail_of_file(path: Path, size: tuple[int, int]) -> Float64[np.ndarray, "8"]:
    """Measure the detail of a photo whose camera is not known; see `detail_of`.

    Args:
        path: Its file.
        size: Width and height as stored, px.

    Raises:
        DatasetError: it cannot be decoded.
    """
    pixels, alpha = decode(path, smaller=WORK_SIDE if size[0] * size[1] <= JPEG_ONLY else None)
    small = shrunk(pixels, WORK_SIDE)
    return detail_of(small, _inner(_counting(alpha, None, small.shape[:2])))


def detail_of(
    pixels: UInt8[np.ndarray, "H W 3"], counts: Bool[np.ndarray, "H W"] | None = None
) -> Float64[np.ndarray, "8"]:
    """Measure a photo's fine detail relative to its coarse detail.

    Args:
        pixels: (H, W, 3) RGB.
        counts: (H, W) the pixels to measure in; None for all.

    Returns:
        ln((E_fine + c) / (E_coarse + c)) for each of eight directions, where E is the mean squared slope of the
        smoothed grey image along that direction; 0 if no pixel counts.
    """
    if counts is not None and not counts.any():
        return np.zeros(len(ANGLES))
    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = _energy(gray, FINE, counts), _energy(gray, COARSE, counts)
    return np.log((fine + FLAT) / (coarse + FLAT))


def _energy(
    gray: Float32[np.ndarray, "H W"], sigma: float, counts: Bool[np.ndarray, "H W"] | None
) -> Float64[np.ndarray, "8"]:
    """Return the mean squared slope in each direction: c² xx + 2 c s xy + s² yy, with structure tensor xx, xy, yy."""
    smooth = cv2.GaussianBlur(gray, (0, 0), sigma)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    if counts is not None:
        gx, gy = gx[counts], gy[counts]
    xx, yy, xy = (float(np.mean(a * b, dtype=np.float64)) for a, b in ((gx, gx), (gy, gy), (gx, gy)))
    c, s = np.cos(ANGLES), np.sin(ANGLES)
    return np.asarray(c * c * xx + s * s * yy + 2.0 * c * s * xy)


def _decoded(
    source: PhotoFile, side: int
) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"] | None]:
    """Decode a photo over black, and return it with its alpha.

    JPEGs are decoded at a reduced size, the longest side no smaller than `side`. Otherwise as in training, so that both
    refuse the same files.
    """
    smaller = side if source.lens.W * source.lens.H <= JPEG_ONLY else None
    image, alpha = decode(source.path, source.orientation, smaller)
    if alpha is None:
        return image, None
    return np.asarray(Photo(image, alpha).over((0.0, 0.0, 0.0))), alpha


def _shrunk_mask(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "h w"]:
    grey = np.repeat(mask[..., None], 3, axis=2).astype(np.uint8) * 255
    counts: Bool[np.ndarray, "h w"] = shrunk(grey, THUMBNAIL_SIDE)[..., 0] >= 128
    return counts

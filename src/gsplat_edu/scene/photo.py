"""A photo in memory: colour, alpha and mask, over a background, and downscaled to the means of areas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, check_shape, first_index, float64_array

Pixels = UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"]
"""RGB: up to 255, or up to 1."""

OPAQUE = 243
"""Pixels of at least this alpha, 95 %, count as opaque where colours are measured."""

AT_ONCE = 8192
"""Pixels composited over a background at a time."""

ALL_OF_IT = 0.9999
"""A downscaled pixel counts if at least this fraction of its area counts: all, up to float32 rounding."""


@dataclass(frozen=True, eq=False, init=False)
class Photo:
    """The pixels of a view.

    Args:
        image: (H, W, 3) RGB: uint8, not copied; or float from 0 to 1, stored as float32.
        alpha: (H, W) uint8, 255 for opaque pixels; None if the photo is opaque.
        mask: (H, W) true for pixels that count; None if all count.
        outside: (H, W) true for pixels that the capture's mask excludes entirely; None if those are all that do not
            count. Pixels that undistortion leaves without a source, or that are partly excluded, are neither.
        lens_only: Whether the capture has no mask for the photo: undistortion alone excludes pixels.

    Raises:
        ShapeError: the sizes differ.
        ArgumentError: a pixel is NaN or outside 0 to 1, or alpha, mask or outside has another dtype.
    """

    image: Pixels
    alpha: UInt8[np.ndarray, "H W"] | None
    mask: Bool[np.ndarray, "H W"] | None
    outside: Bool[np.ndarray, "H W"] | None
    lens_only: bool

    def __init__(
        self,
        image: ArrayLike,
        alpha: UInt8[np.ndarray, "H W"] | None = None,
        mask: Bool[np.ndarray, "H W"] | None = None,
        outside: Bool[np.ndarray, "H W"] | None = None,
        lens_only: bool = False,
    ) -> None:
        pixels = np.asarray(image)
        if pixels.dtype != np.uint8:
            values = float64_array("image", image, ("H", "W", 3))
            if np.any(beyond := (values < 0) | (values > 1)):
                where = first_index(beyond)
                raise ArgumentError(
                    f"image{where}: is outside 0 to 1; divide by the largest value or give uint8"
                )
            pixels = values.astype(np.float32)
        check_shape("image", pixels.shape, ("H", "W", 3), {})
        planes = (("alpha", alpha, np.uint8), ("mask", mask, np.bool_), ("outside", outside, np.bool_))
        for name, plane, dtype in planes:
            if plane is not None:
                check_shape(name, plane.shape, pixels.shape[:2], {})
                if plane.dtype != dtype:
                    raise ArgumentError(f"{name}: is {plane.dtype}, but has to be {np.dtype(dtype)}")
        for name, value in {"image": pixels, "alpha": alpha, "mask": mask, "outside": outside}.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "lens_only", lens_only)

    @property
    def nbytes(self) -> int:
        """Size of the pixels in bytes."""
        return sum(a.nbytes for a in (self.image, self.alpha, self.mask, self.outside) if a is not None)

    @property
    def excluded(self) -> Bool[np.ndarray, "H W"] | None:
        """Where the capture's mask excludes all of a pixel, (H, W); None if nothing does."""
        if self.outside is not None or self.mask is None or self.lens_only:
            return self.outside
        return ~self.mask

    @property
    def opaque(self) -> Bool[np.ndarray, "H W"] | None:
        """Where the photo is opaque but for a twentieth, (H, W); None if it has no alpha."""
        return None if self.alpha is None else self.alpha >= OPAQUE

    def counting(self, counts: Bool[np.ndarray, "H W"]) -> Photo:
        """Return the photo with fewer pixels that count; what the capture's mask excludes stays the same.

        Args:
            counts: (H, W) true for pixels that still count, if the photo's own mask lets them.
        """
        outside = np.zeros(counts.shape, dtype=bool) if self.excluded is None else self.excluded
        mask = counts if self.mask is None else counts & self.mask
        return Photo(self.image, self.alpha, mask, outside, self.lens_only)

    def over(self, background: ArrayLike) -> Pixels:
        """Composite the photo over a background: rgb alpha + background (1 - alpha).

        Args:
            background: (3,) colour, 0 to 1.

        Returns:
            (H, W, 3) the photo itself if it is opaque; else uint8, rounded.
        """
        if self.alpha is None:
            return self.image
        behind = np.asarray(background, dtype=np.float32)
        flat: UInt8[np.ndarray, "H W 3"] = np.empty(self.image.shape, dtype=np.uint8)
        rows = max(1, AT_ONCE // max(self.image.shape[1], 1))
        for top in range(
            0, len(flat), rows
        ):  # in blocks: the floats of a few rows stay in the cache and out of the heap
            band = slice(top, top + rows)
            share = self.alpha[band, :, None].astype(np.float32) / 255.0
            image = self.image[band].astype(np.float32) / (255.0 if self.image.dtype == np.uint8 else 1.0)
            mixed = np.clip(image * share + behind * (1.0 - share), 0.0, 1.0)
            flat[band] = np.round(255.0 * mixed)
        return flat

    def scaled(self, W: int, H: int) -> Photo:
        """Return the photo at a smaller size: each pixel is the mean of the area it covers, weighted by alpha.

        A pixel of the mask counts if all of its area does. A float photo with alpha becomes uint8, rounded.

        Args:
            W: New width, px; at most the photo's.
            H: New height, px; at most the photo's.
        """
        if self.image.shape[:2] == (H, W):
            return self
        return Photo.averaged(self.weighted, self.mask, self.excluded, W, H, self.lens_only)

    @property
    def weighted(self) -> Pixels | Float32[np.ndarray, "H W 4"]:
        """What averages as it should: the image; with alpha, colour times alpha, and alpha, both up to 255."""
        if self.alpha is None:
            return self.image
        image = self.image if self.image.dtype == np.uint8 else 255.0 * self.image
        return premultiplied(image, self.alpha)

    @classmethod
    def averaged(
        cls,
        pixels: Pixels | Float32[np.ndarray, "H W 4"],
        mask: Bool[np.ndarray, "H W"] | None,
        outside: Bool[np.ndarray, "H W"] | None,
        W: int,
        H: int,
        lens_only: bool,
    ) -> Photo:
        """Return a smaller photo.

        Args:
            pixels: What `weighted` gives.
            mask: (H, W) true for pixels that count; None if all count.
            outside: As for `Photo`, but given wherever there is a mask of the capture.
            W: New width, px; at most that of the pixels.
            H: New height, px.
            lens_only: As for `Photo`.
        """
        small = area_mean(pixels, W, H)
        image, alpha = unweighted(small) if small.shape[2] == 4 else (small, None)
        counts, excluded = (None if part is None else smaller_mask(part, W, H) for part in (mask, outside))
        return cls(image, alpha, counts, excluded, lens_only)


def area_mean(pixels: Shaped[np.ndarray, "H W *c"], W: int, H: int) -> Shaped[np.ndarray, "h w *c"]:
    """Return an image at another size, of the same dtype; each pixel is the mean of the area it covers.

    Args:
        pixels: (H, W) or (H, W, c) image, uint8 or float32.
        W: New width, px; not larger than the image's.
        H: New height, px; not larger than the image's.
    """
    if pixels.shape[:2] == (H, W):
        return pixels
    import cv2  # here, because the command line's options import views, and OpenCV takes long to import

    return np.asarray(cv2.resize(pixels, (W, H), interpolation=cv2.INTER_AREA))


def resized_mask(mask: Bool[np.ndarray, "h w"], H: int, W: int) -> Bool[np.ndarray, "H W"]:
    """Return a mask at another size, by the nearest pixel."""
    rows = (2 * np.arange(H) + 1) * mask.shape[0] // (2 * H)
    columns = (2 * np.arange(W) + 1) * mask.shape[1] // (2 * W)
    return np.ascontiguousarray(mask[rows][:, columns])


def shrunk(pixels: Shaped[np.ndarray, "H W *c"], longest: int) -> Shaped[np.ndarray, "h w *c"]:
    """Return an image whose longer side is at most so long, of the same shape and dtype; see `area_mean`.

    Args:
        pixels: As for `area_mean`.
        longest: Longest side, px.
    """
    factor = min(1.0, longest / max(pixels.shape[:2]))
    H, W = (max(1, round(factor * side)) for side in pixels.shape[:2])
    return area_mean(pixels, W, H)


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

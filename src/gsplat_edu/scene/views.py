"""A view: a camera and its photo, independent of their source. The trainer consumes views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, check_shape, first_index, float64_array
from gsplat_edu.photos.resizing import area_mean, premultiplied, smaller_mask, unweighted
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.given_depth import GivenDepth

Pixels = UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"]


OPAQUE = 243
"""Pixels of at least this alpha, 95 %, count as opaque where colours are measured."""

AT_ONCE = 8192
"""Pixels composited over a background at a time."""


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
        mask = None if self.mask is None else smaller_mask(self.mask, W, H)
        outside = None if self.excluded is None else smaller_mask(self.excluded, W, H)
        if self.alpha is None:
            return Photo(area_mean(self.image, W, H), None, mask, outside, self.lens_only)
        bytes_like = self.image if self.image.dtype == np.uint8 else 255.0 * self.image
        weighted = np.asarray(bytes_like, dtype=np.float32)
        image, alpha = unweighted(area_mean(premultiplied(weighted, self.alpha), W, H))
        return Photo(image, alpha, mask, outside, self.lens_only)


@dataclass(frozen=True, eq=False, init=False)
class View:
    """A camera and its photo, in memory or still on disk.

    Args:
        camera: The camera.
        image: (H, W, 3) photo, of the camera's size; see `Photo`.
        alpha: (H, W) opacity of the photo, uint8; None if it is opaque.
        mask: (H, W) true for pixels that count; None if all count.
        name: The view's name in the capture.

    Raises:
        ShapeError: the sizes of photo and camera differ.
        ArgumentError: as for `Photo`.

    Attributes:
        read: Returns the photo, from memory or from disk; may be called from another thread.
        on_disk: Whether reading takes time, so that prefetching pays off.
        depth: Returns the depth that the user has for the view; None if there is none.
    """

    camera: Camera
    name: str
    read: Callable[[], Photo]
    on_disk: bool
    depth: Callable[[], GivenDepth] | None

    def __init__(
        self,
        camera: Camera,
        image: ArrayLike,
        *,
        alpha: UInt8[np.ndarray, "H W"] | None = None,
        mask: Bool[np.ndarray, "H W"] | None = None,
        name: str = "",
    ) -> None:
        photo = Photo(image, alpha, mask)
        check_shape("image", photo.image.shape, (camera.H, camera.W, 3), {})
        self._set(camera, name, lambda: photo, on_disk=False)

    @classmethod
    def stored(cls, camera: Camera, read: Callable[[], Photo], name: str = "") -> View:
        """Make a view whose photo is read on demand.

        Args:
            camera: The camera.
            read: Returns the photo, of the camera's size.
            name: The view's name in the capture.
        """
        view = cls.__new__(cls)
        view._set(camera, name, read, on_disk=True)
        return view

    def with_depth(self, depth: Callable[[], GivenDepth] | None) -> View:
        """Return the view with depth that the user has.

        Args:
            depth: Returns it, from memory or from disk, the same at each call; None for none.
        """
        view = View.__new__(View)
        view._set(self.camera, self.name, self.read, on_disk=self.on_disk, depth=depth)
        return view

    def scaled(self, factor: float) -> View:
        """Return the view with width and height divided by a factor, and intrinsics that fit exactly.

        Its photo is downscaled whenever it is read; see `Photo.scaled`.

        Args:
            factor: At least 1; a side keeps at least one pixel.
        """
        if factor == 1.0:
            return self
        W, H = (max(1, round(side / factor)) for side in (self.camera.W, self.camera.H))
        return View.stored(self.camera.scaled(W, H), lambda: self.read().scaled(W, H), self.name).with_depth(
            self.depth
        )

    def _set(
        self,
        camera: Camera,
        name: str,
        read: Callable[[], Photo],
        on_disk: bool,
        depth: Callable[[], GivenDepth] | None = None,
    ) -> None:
        values = {"camera": camera, "name": name, "read": read, "on_disk": on_disk, "depth": depth}
        for key, value in values.items():
            object.__setattr__(self, key, value)

    @property
    def image(self) -> Pixels:
        """RGB of the photo, (H, W, 3)."""
        return self.read().image

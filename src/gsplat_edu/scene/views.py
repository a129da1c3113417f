"""A view: a camera and its photo, independent of their source. The trainer consumes views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, UInt8

from gsplat_edu.base.validation import ArrayLike, check_shape
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.given_depth import GivenDepth
from gsplat_edu.scene.photo import Photo, Pixels


@dataclass(frozen=True, eq=False, init=False, repr=False)
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
        self._set(camera, name, partial(_kept, photo), on_disk=False)

    def __repr__(self) -> str:
        """Return one line: name, size, and where the photo is."""
        where = "on disk" if self.on_disk else "in memory"
        return f"View({self.name!r}, {self.camera.W}x{self.camera.H} px, {where})"

    @classmethod
    def stored(cls, camera: Camera, read: Callable[[], Photo], name: str = "") -> View:
        """Make a view whose photo is read on demand.

        Args:
            camera: The camera.
            read: Returns the photo, of the camera's size. Other processes get the view only if this can be pickled.
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

    def with_camera(self, camera: Camera) -> View:
        """Return the view with another camera, and without depth, which is that of its own camera.

        Args:
            camera: The camera, of the photo's size.
        """
        return View.stored(camera, self.read, self.name)

    def scaled(self, factor: float) -> View:
        """Return the view with width and height divided by a factor, and intrinsics that fit exactly.

        Its photo is downscaled whenever it is read; see `Photo.scaled`.

        Args:
            factor: At least 1; a side keeps at least one pixel.
        """
        if factor == 1.0:
            return self
        W, H = (max(1, round(side / factor)) for side in (self.camera.W, self.camera.H))
        read = partial(read_scaled, self, W, H)
        return View.stored(self.camera.scaled(W, H), read, self.name).with_depth(self.depth)

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


def _kept(photo: Photo) -> Photo:
    return photo


def read_scaled(view: View, W: int, H: int) -> Photo:
    """Read the photo of a view, at another size.

    Args:
        view: The view.
        W: Width, px; at most the photo's.
        H: Height, px; at most the photo's.
    """
    return view.read().scaled(W, H)

"""Photos of which only the pixels count that may show the region of interest."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.region import Region, seen_in
from gsplat_edu.scene.views import View

AROUND = 4
"""px: this far around the box's place in a photo, pixels count too: what crosses its border needs both sides."""

PROBED = 64
"""Longest side, px, of the images by which photos that do not show the box are found."""


def views_of_region(views: Sequence[View], region: Region) -> tuple[View, ...]:
    """Return views whose masks leave out what does not show a box.

    Args:
        views: The views.
        region: The box, in the cameras' coordinates.

    Raises:
        DatasetError: no photo shows the box.
    """
    if not any(counted(region, _small(view.camera)).any() for view in views):
        raise DatasetError(
            "region.json: no photo shows the box; draw it anew with gsplat-edu view, or take `region=none`"
        )
    read = [_PhotoOfRegion(view, region).read for view in views]
    return tuple(
        View.stored(view.camera, one, view.name).with_depth(view.depth)
        for view, one in zip(views, read, strict=True)
    )


def counted(region: Region, camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Return the pixels that count: those whose ray meets the box, and `AROUND` px around them."""
    side = 2 * AROUND + 1
    around = cv2.dilate(seen_in(region, camera).view(np.uint8), np.ones((side, side), np.uint8))
    found: Bool[np.ndarray, "H W"] = around.view(np.bool_)
    return found


class _PhotoOfRegion:
    """Reads a photo with the mask of a box, which is computed once and kept as bits."""

    def __init__(self, view: View, region: Region) -> None:
        self._view, self._region = view, region
        self._bits: UInt8[np.ndarray, "H w"] | None = None

    def read(self) -> Photo:
        if self._bits is None:  # two threads may compute it; both find the same
            self._bits = np.packbits(counted(self._region, self._view.camera), axis=1)
        counts = np.unpackbits(self._bits, axis=1, count=self._view.camera.W).view(np.bool_)
        return self._view.read().counting(counts)


def _small(camera: Camera) -> Camera:
    factor = max(1.0, max(camera.W, camera.H) / PROBED)
    return camera.scaled(max(1, round(camera.W / factor)), max(1, round(camera.H / factor)))

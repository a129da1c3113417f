"""The region of interest: a box. A training looks only at pixels of the photos that may show something in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import float64_array
from gsplat_edu.scene.camera import Camera

NUMBERS = 15
"""Numbers that describe a region: 3 of the centre, 9 of the rotation row by row, 3 half extents."""

FARTHEST = 1e9
"""Largest coordinate and half extent, world units."""

BENT = 1e-6
"""Largest deviation of R R' from the identity for a rotation R."""


@dataclass(frozen=True, eq=False)
class Region:
    """A box of any orientation.

    Args:
        center: (3,) its centre, world units.
        rotation: (3, 3) a rotation whose columns are the directions of the box's edges.
        half: (3,) half its extent along each of them, world units.

    Raises:
        ArgumentError: a number is out of range, or the rotation is none.
    """

    center: Float64[np.ndarray, "3"]
    rotation: Float64[np.ndarray, "3 3"]
    half: Float64[np.ndarray, "3"]

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name, shape in (("center", (3,)), ("rotation", (3, 3)), ("half", (3,))):
            object.__setattr__(self, name, float64_array(name, getattr(self, name), shape))
        if np.abs(self.center).max() > FARTHEST:
            raise ArgumentError(f"center: has to be within {FARTHEST:g} of 0")
        if self.half.min() <= 0.0 or self.half.max() > FARTHEST:
            raise ArgumentError(f"half: has to be above 0 and at most {FARTHEST:g}")
        R = self.rotation
        if np.abs(R @ R.T - np.eye(3)).max() > BENT or np.linalg.det(R) < 0.0:
            raise ArgumentError("rotation: has to be a rotation matrix")

    @classmethod
    def of_numbers(cls, numbers: Sequence[float]) -> Region:
        """Return the region that `numbers` describes.

        Args:
            numbers: As `numbers` returns them.

        Raises:
            ArgumentError: they are not `NUMBERS` numbers of a region.
        """
        found = float64_array("region", numbers, (NUMBERS,))
        return cls(found[:3], found[3:12].reshape(3, 3), found[12:])

    @property
    def numbers(self) -> tuple[float, ...]:
        """Centre, rotation row by row, and half extents."""
        return tuple(float(x) for x in (*self.center, *self.rotation.ravel(), *self.half))

    def moved(self, by: Float64[np.ndarray, "3"]) -> Region:
        """Return the region moved by a vector, world units."""
        return Region(self.center + by, self.rotation, self.half)


def seen_in(region: Region, camera: Camera) -> Bool[np.ndarray, "H W"]:
    """Return the pixels of a photo whose ray meets a box; what hides the box is not considered.

    Args:
        region: The box.
        camera: The photo's camera; any lens, and a shutter.
    """
    rays = camera.rays().reshape(-1, 3) @ region.rotation
    starts = (camera.origins().reshape(-1, 3) - region.center) @ region.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(side * region.half - starts) / rays for side in (-1.0, 1.0)])
    # a ray along a side of the box gives 0 / 0 there, and that side does not bound it
    first, last = np.fmin(*ends), np.fmax(*ends)
    into, out = np.fmax.reduce(first, axis=1), np.fmin.reduce(last, axis=1)
    met = np.isfinite(rays).all(axis=1) & (out >= np.maximum(into, 0.0))
    return np.asarray(met.reshape(camera.H, camera.W))

"""Depth that the user has for a view: samples of a sensor's or a network's map, or the points that the photo sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array

POINTS_AS_DEPTH, CAPTURE_AS_DEPTH, SCAN_AS_DEPTH = "points", "capture", "scan"
"""Sources of depth that are no folder: the points in COLMAP's tracks, the maps that the capture names, and the point
cloud that the training starts from."""


@dataclass(frozen=True, eq=False, init=False)
class GivenDepth:
    """Depth along some rays of a camera. Rays have no pixels, so they fit a photo of any size.

    Args:
        rays: (M, 2) place of each ray on the plane of the camera's projection, (u - cx) / fx and (v - cy) / fy, without
            units: x / z and y / z of the ray in the axes of a pinhole.
        depths: (M,) depth of that projection, above 0, world units: z, or the distance from the camera's centre if the
            projection is `along_ray`.
        weights: (M,) at least 0; how much each depth counts. None for 1 each.
        sparse: Whether these are triangulated points instead of measured depth.

    Raises:
        ShapeError: the sizes differ.
        ArgumentError: a value is NaN, infinite or out of range.
    """

    rays: Float32[np.ndarray, "M 2"]
    depths: Float32[np.ndarray, " M"]
    weights: Float32[np.ndarray, " M"]
    sparse: bool

    def __init__(
        self, rays: ArrayLike, depths: ArrayLike, weights: ArrayLike | None = None, *, sparse: bool = False
    ) -> None:
        sizes: dict[str, int] = {}
        given = float64_array("rays", rays, ("M", 2), sizes)
        z = float64_array("depths", depths, ("M",), sizes)
        each = np.ones(len(z)) if weights is None else float64_array("weights", weights, ("M",), sizes)
        for name, values, wrong in (("depths", z, z <= 0), ("weights", each, each < 0)):
            if wrong.any():
                first = int(np.flatnonzero(wrong)[0])
                raise ArgumentError(f"{name}[{first}]: is {values[first]:g}, but has to be larger")
        for name, array in (("rays", given), ("depths", z), ("weights", each)):
            object.__setattr__(self, name, array.astype(np.float32))
        object.__setattr__(self, "sparse", sparse)

    def __len__(self) -> int:
        return len(self.depths)

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return self.rays.nbytes + self.depths.nbytes + self.weights.nbytes

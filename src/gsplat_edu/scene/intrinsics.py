"""Intrinsics as a value: focal lengths, principal point, image size and projection."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.scene.projection import PINHOLE, Projection

_Kind = TypeVar("_Kind", bound="Intrinsics")

UNEVEN = 1.1
"""Ratio of the focal lengths from which pixels count as not square. Those of cameras are square, and good calibrations
find the ratio within 1 %."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a camera.

    Args:
        W: Image width, px.
        H: Image height, px.
        fx: Focal length along x, px.
        fy: Focal length along y, px.
        cx: Column of the principal point, px; pixel centres have integer coordinates.
        cy: Row of the principal point, px.
        projection: How the lens projects; a pinhole by default.

    Raises:
        ArgumentError: a size is below 1, a focal length is not positive, or a number is NaN or infinite.
    """

    W: int
    H: int
    fx: float
    fy: float
    cx: float
    cy: float
    projection: Projection = field(default=PINHOLE, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("W", "H"):
            if getattr(self, name) < 1:
                raise ArgumentError(f"{name}: is {getattr(self, name)}, but must be at least 1")
        for name in ("fx", "fy", "cx", "cy"):
            if not math.isfinite(value := getattr(self, name)) or (name in ("fx", "fy") and value <= 0):
                raise ArgumentError(
                    f"{name}: is {value:g}, but must be finite{' and positive' * (name[0] == 'f')}"
                )

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """The intrinsic matrix (3, 3), px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def uneven(self) -> bool:
        """Whether the focal lengths differ by more than the pixels of real cameras explain; see `UNEVEN`."""
        return not 1 / UNEVEN < self.fx / self.fy < UNEVEN

    def scaled(self: _Kind, W: int, H: int) -> _Kind:
        """Return the intrinsics of the same photo at another size.

        f' = f s,  c' = (c + 1/2) s - 1/2: this keeps the image's edge in place, not the centre of its first pixel.

        Args:
            W: New width, px.
            H: New height, px.
        """
        sx, sy = W / self.W, H / self.H
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return replace(self, W=W, H=H, fx=self.fx * sx, fy=self.fy * sy, cx=cx, cy=cy)

    def turned(self, turns: int) -> Intrinsics:
        """Return the intrinsics of the photo turned clockwise: (u, v) becomes (H - 1 - v, u).

        Args:
            turns: Quarter turns.

        Raises:
            ArgumentError: of an equirectangular image.
        """
        found = Intrinsics(self.W, self.H, self.fx, self.fy, self.cx, self.cy, projection=self.projection)
        for _ in range(turns % 4):
            cx, cy, projection = found.H - 1 - found.cy, found.cx, found.projection.turned()
            found = Intrinsics(found.H, found.W, found.fy, found.fx, cx, cy, projection=projection)
        return found

    def undistorted(self) -> Intrinsics:
        """Return the pinhole of the undistorted photo: these intrinsics, since a pinhole does not distort."""
        return self

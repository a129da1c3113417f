"""What all passes of a render share: the camera and the settings, packed as the uniform block `View` of `view.wgsl`."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from gsplat_edu.base.constants import T_STOP, TILE
from gsplat_edu.scene.camera import Camera

FARTHEST = 3e38
"""Stands for infinity, which WGSL lets a compiler assume away."""

NO_STOP = -1.0
"""Transmittance that no pixel reaches."""


@dataclass(frozen=True)
class DeviceView:
    """The camera and the settings of one render; they mean what `gsplat_edu.render.settings.RenderSettings` says.

    Args:
        camera: The camera.
        background: RGB colour behind everything.
        sh_degree: Degree of the harmonics that are used.
        antialiased: Whether opacities are lowered to compensate for the dilation.
        dilation: px².
        jacobian_limit: Multiple of half the field of view, or None.
        alpha_max: Clamp of alpha.
        z_near: World units.
        pixel_stop: Whether compositing ends for each pixel by itself.
    """

    camera: Camera
    background: tuple[float, float, float]
    sh_degree: int
    antialiased: bool
    dilation: float
    jacobian_limit: float | None
    alpha_max: float
    z_near: float
    pixel_stop: bool = False

    @property
    def tiles_x(self) -> int:
        """Tiles in a row of them."""
        return -(-self.camera.W // TILE)

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        return self.tiles_x * -(-self.camera.H // TILE)

    def packed(self, rest: int) -> bytes:
        """Return the uniform block.

        Args:
            rest: Harmonics per Gaussian in the scene, besides the first.
        """
        camera = self.camera
        eye = np.asarray(camera.eye, dtype=np.float64)
        high = eye.astype(np.float32)
        rows = [(*row, 0.0) for row in camera.R]
        bounds = np.clip(camera.jacobian_bounds(self.jacobian_limit), -FARTHEST, FARTHEST)
        numbers = (
            *(value for row in rows for value in row),
            *(*high, 0.0),
            *(*(eye - high), 0.0),
            *(camera.fx, camera.fy, camera.cx, camera.cy),
            *(bounds[0][0], bounds[1][0], bounds[0][1], bounds[1][1]),
            *(*self.background, T_STOP if self.pixel_stop else NO_STOP),
            *(self.z_near, self.dilation, self.alpha_max, math.log2(self.alpha_max)),
        )
        whole = (camera.W, camera.H, self.tiles_x, self.tiles, self.sh_degree, rest, int(self.antialiased), 0)
        return struct.pack(f"<{len(numbers)}f8I", *numbers, *whole)

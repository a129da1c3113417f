"""What all passes of a render share: the camera and the settings, packed as the uniform block `View` of `view.wgsl`."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from gsplat_edu.base.constants import T_STOP, TILE
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import COEFFICIENTS, PROJECTIONS
from gsplat_edu.scene.shutter import readout_axis, readout_pace

FARTHEST = 3e38
"""Stands for infinity, which WGSL lets a compiler assume away."""

NO_STOP = -1.0
"""Transmittance that no pixel reaches."""

LENS_PLACE = 496
"""Bytes of the uniform block before the lens."""

OPTICS = ("pinhole", "lens", "panorama")
"""What a program is for: a pinhole at rest; any other camera; one whose image's left and right edges meet."""


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

    @property
    def optics(self) -> str:
        """Which of the `OPTICS` the camera needs."""
        if self.camera.pinhole:
            return "pinhole"
        return "panorama" if self.camera.projection.kind == "equirectangular" else "lens"

    def packed(self, rest: int, numbers: bytes = b"") -> bytes:
        """Return the uniform block.

        Args:
            rest: Harmonics per Gaussian in the scene, besides the first.
            numbers: Of a step of training; they follow the view.
        """
        camera = self.camera
        eye = np.asarray(camera.eye, dtype=np.float64)
        high = eye.astype(np.float32)
        rows = [(*row, 0.0) for row in camera.R]
        bounds = np.clip(camera.jacobian_bounds(self.jacobian_limit), -FARTHEST, FARTHEST)
        floats = (
            *(value for row in rows for value in row),
            *(*high, 0.0),
            *(*(eye - high), 0.0),
            *(camera.fx, camera.fy, camera.cx, camera.cy),
            *(bounds[0][0], bounds[1][0], bounds[0][1], bounds[1][1]),
            *(*self.background, T_STOP if self.pixel_stop else NO_STOP),
            *(self.z_near, self.dilation, self.alpha_max, math.log2(self.alpha_max)),
        )
        whole = (camera.W, camera.H, self.tiles_x, self.tiles, self.sh_degree, rest, int(self.antialiased), 0)
        block = struct.pack(f"<{len(floats)}f8I", *floats, *whole) + numbers
        if self.optics == "pinhole":
            return block
        return block.ljust(LENS_PLACE, b"\0") + packed_lens(camera, self.jacobian_limit is not None)


def packed_lens(camera: Camera, limited: bool) -> bytes:
    """Return lens and rolling shutter of a camera, as `lens.wgsl` reads them.

    Args:
        camera: The camera.
        limited: Whether there is a `jacobian_limit`.
    """
    kind, widest = camera.projection.kind, camera.widest
    bound = {"perspective": math.tan(widest) ** 2, "fisheye": math.cos(widest)}.get(kind, 0.0)
    coefficients, axis = camera.coefficients or (0.0,) * len(COEFFICIENTS), readout_axis(camera.readout)
    motion = camera.motion or (0.0,) * 6
    numbers = (
        *(*coefficients, bound),
        *(*motion[:3], readout_pace(camera.readout, camera.H, camera.W)),
        *(*motion[3:], 0.5 * ((camera.W, camera.H)[axis] - 1)),
    )
    flags = (camera.coefficients is not None, camera.projection.radial_first, camera.motion is not None)
    bounded = limited and kind == "perspective"
    whole = (PROJECTIONS.index(kind), *flags, axis, camera.projection.along_ray, bounded)
    spread = camera.exposure / math.sqrt(12.0)
    return struct.pack(f"<{len(numbers)}f7If", *numbers, *map(int, whole), spread)

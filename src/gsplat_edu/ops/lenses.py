"""Cameras for the native kernels: their numbers, and the rays of their pixels."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from gsplat_edu.ops.kernels import native
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import COEFFICIENTS, PROJECTIONS
from gsplat_edu.scene.shutter import MOTION_NUMBERS, readout_axis, readout_pace

RAY_ROOM = 1 << 28
"""Bytes of rays that are kept in memory; those of other lenses are computed again."""

BAND = 1 << 18
"""Pixels whose rays are computed together: the inverse of a distortion needs some 30 float64 arrays of this size."""

Bounds = tuple[tuple[float, float], tuple[float, float]]
"""(low, high) of x/z and of y/z."""


def native_camera(camera: Camera, bounds: Bounds, lens: bool) -> Any:  # noqa: ANN401
    """Return a camera for the native kernels.

    Args:
        camera: The camera.
        bounds: Of x/z and y/z in the Jacobian: `Camera.jacobian_bounds`.
        lens: Whether the kernels of lenses are to be used; always true of a camera that is no pinhole.
    """
    x_bounds, y_bounds = bounds
    return native().Camera(
        R=np.ascontiguousarray(camera.R, dtype=np.float64),
        eye=np.ascontiguousarray(camera.eye, dtype=np.float64),
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        x_bounds=x_bounds,
        y_bounds=y_bounds,
        H=camera.H,
        W=camera.W,
        **(_lens(camera) if lens else {}),
    )


def _lens(camera: Camera) -> dict[str, Any]:
    """Return what the native camera has beside a pinhole's numbers."""
    kind, coefficients = camera.projection.kind, camera.coefficients
    bound = {"perspective": math.tan(camera.widest) ** 2, "fisheye": math.cos(camera.widest)}
    return {
        "lens": PROJECTIONS.index(kind),
        "distorted": coefficients is not None,
        "coefficients": coefficients or (0.0,) * len(COEFFICIENTS),
        "radial_first": camera.projection.radial_first,
        "widest": bound.get(kind, 0.0),
        "moving": camera.motion is not None,
        "motion": camera.motion or (0.0,) * MOTION_NUMBERS,
        "axis": readout_axis(camera.readout),
        "pace": readout_pace(camera.readout, camera.H, camera.W),
        "exposure": camera.exposure,
    }


def native_rays(camera: Camera, dtype: torch.dtype) -> dict[str, Any]:
    """Return the rays of a camera's pixels as the native kernels take them: `rays`, `frames`, `axis` and `wraps`.

    Args:
        camera: Any camera but an orthographic one.
        dtype: Of the rays; float32 or float64.
    """
    wanted = np.dtype(np.float32 if dtype == torch.float32 else np.float64)
    return {
        "rays": _RAYS.of(camera, wanted),
        "frames": frames_of(camera),
        "axis": readout_axis(camera.readout),
        "wraps": int(camera.projection.wraps),
    }


def within_width(u: Tensor, W: int) -> Tensor:
    """Return columns of a closed image, whose first and last columns are neighbours, less whole widths: 0 to below W.

    Args:
        u: Any shape, px.
        W: Width of the image, px.
    """
    turned = torch.remainder(u, W)
    return torch.where(turned < W, turned, 0.0)  # the remainder may be rounded up to W


def frames_of(camera: Camera) -> Float64[np.ndarray, "L 12"]:
    """Return a camera's frames while it is read: L is 1 at rest, otherwise H or W.

    A frame has nine numbers of the rotation from the camera's axes to the world's, row by row, and the centre less that
    at half time, world units.
    """
    still = np.concatenate([camera.R.T.ravel(), np.zeros(3)])
    shutter = camera.shutter
    if shutter is None or readout_pace(camera.readout, camera.H, camera.W) == 0:
        return still[None]
    times = shutter.times(camera.H, camera.W)
    along = times[0] if shutter.axis == 0 else times[:, 0]
    turns = [(shutter.rotation(time) @ camera.R).T.ravel() for time in along.tolist()]
    return np.concatenate([np.stack(turns), along[:, None] * shutter.shift], axis=1)


class _Rays:
    """The rays of lenses in camera axes. All photos of a lens share them; the last ones used are kept."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Any, Float[np.ndarray, "H W 3"]] = OrderedDict()
        self._lock = threading.Lock()

    def of(self, camera: Camera, dtype: np.dtype[Any]) -> Float[np.ndarray, "H W 3"]:
        """Return (H, W, 3) rays of depth 1, and zeros where a pixel has no ray."""
        key = (camera.intrinsics, camera.widest, dtype)
        with self._lock:
            found = self._kept.pop(key, None)
            if found is None:
                found = _rays(camera, dtype)
            self._kept[key] = found  # the last one used
            while sum(rays.nbytes for rays in self._kept.values()) > RAY_ROOM and len(self._kept) > 1:
                self._kept.popitem(last=False)
            return found


_RAYS = _Rays()


def _rays(camera: Camera, dtype: np.dtype[Any]) -> Float[np.ndarray, "H W 3"]:
    rays = np.empty((camera.H, camera.W, 3), dtype)
    x = (np.arange(camera.W) - camera.cx) / camera.fx
    rows = max(1, BAND // camera.W)
    for first in range(0, camera.H, rows):
        y = (np.arange(first, min(first + rows, camera.H)) - camera.cy) / camera.fy
        a, b = np.meshgrid(x, y)
        found = camera.projection.directions(a, b, camera.widest)
        rays[first : first + rows] = np.where(np.isfinite(found).all(axis=-1, keepdims=True), found, 0.0)
    rays.flags.writeable = False
    return rays

"""What a pinhole shows of a scene that was trained through wide lenses.

The ellipse of a splat far beside a pinhole's image is wrong by far more than that of a lens (chapter 04), even with a
clamped Jacobian, and no wide photo ever corrected it: such splats lie over the image as a veil. They are left out. On a
traced garden that was trained through fisheyes of 180 degrees, a pinhole of 60 degrees had 24.1 dB with them and 26.0
without; a scene that was trained from undistorted photos does not change (26.2).
"""

from __future__ import annotations

import math

import torch

from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians

BEYOND = 2.0
"""Means are shown up to this multiple of |x / z| and |y / z| at the edges of the image."""

LEAST_BEYOND = math.tan(math.radians(50.0))
"""Means up to this |x / z| and |y / z| are shown at any focal length: within 50 degrees, a splat that is larger than a
small field of view may cover it."""


def field_of(camera: Camera) -> tuple[float, float]:
    """Return the largest |x / z| and |y / z| of means that a pinhole shows of such a scene.

    Args:
        camera: A pinhole.
    """
    edges = (
        max(0.5 + camera.cx, camera.W - 0.5 - camera.cx) / camera.fx,
        max(0.5 + camera.cy, camera.H - 0.5 - camera.cy) / camera.fy,
    )
    x, y = (max(BEYOND * edge, LEAST_BEYOND) for edge in edges)
    return x, y


def within_field(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Return the Gaussians whose means a camera shows; all of them if it is no pinhole.

    Args:
        gaussians: A scene that was trained through wide lenses.
        camera: The camera.
    """
    if not camera.pinhole:
        return gaussians
    means = gaussians.means.detach().double()
    eye, turn = (
        torch.tensor(array.tolist(), dtype=means.dtype, device=means.device)
        for array in (camera.eye, camera.R)
    )
    x, y, z = ((means - eye) @ turn.T).T
    widest = field_of(camera)
    return gaussians[(x.abs() <= widest[0] * z) & (y.abs() <= widest[1] * z)]

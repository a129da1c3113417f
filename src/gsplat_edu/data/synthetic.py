"""Views of a procedural scene, rendered with the NumPy reference: a capture with known ground truth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gsplat_edu.render.numpy_reference import render_gaussians
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import orbit_camera
from gsplat_edu.scene.sphere_shell import sphere_shell
from gsplat_edu.scene.views import View

ORBIT_RADIUS = 3.0
"""Distance of the course's cameras to the sphere's centre, world units."""

ELEVATIONS = (-0.35, 0.0, 0.35)
"""Elevations of the three rings of training cameras, radians."""

CAMERAS_PER_RING = 8

HELD_OUT = (math.radians(202.5), 0.18)
"""Azimuth and elevation of the held-out camera, radians: between the rings and between their cameras."""

FX_PER_PX = 150.0 / 128.0
"""Focal length per pixel of image size: 150 px at 128 px. So every size has the same field of view."""


class SphereCapture(NamedTuple):
    """The course's capture of the sphere."""

    train: list[View]
    held_out: View


def sphere_cameras(size: int) -> list[Camera]:
    """Make the 24 training cameras, ring by ring and by azimuth within a ring.

    Args:
        size: Height and width of the images, px.
    """
    turn = 2.0 * math.pi / CAMERAS_PER_RING
    return [
        _camera(step * turn, elevation, size) for elevation in ELEVATIONS for step in range(CAMERAS_PER_RING)
    ]


def sphere_capture(size: int) -> SphereCapture:
    """Photograph `sphere_shell()` with 24 training cameras and a held-out camera, on black.

    Args:
        size: Height and width of the images, px.

    Raises:
        ArgumentError: the size is not a whole number of at least 1.
    """
    shell = sphere_shell()

    def photograph(camera: Camera) -> View:
        image, _ = render_gaussians(camera, *shell)
        return View(camera, np.clip(image, 0.0, 1.0))

    return SphereCapture([photograph(c) for c in sphere_cameras(size)], photograph(_camera(*HELD_OUT, size)))


def _camera(azimuth: float, elevation: float, size: int) -> Camera:
    return orbit_camera(azimuth, elevation, size, FX_PER_PX * size, ORBIT_RADIUS)

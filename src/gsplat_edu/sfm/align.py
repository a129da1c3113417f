"""Choose up direction, origin and scale, which photos alone do not determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.edit import Similarity
from gsplat_edu.paths.orbits import common_up
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import point_nearest_axes

DISTANCE = 5.0
"""Median distance of the cameras from their target, in units of the result. It is similar to COLMAP's own normalisation
(cameras spread over 10), for which renderers chose their near plane: 0.2 in the code of Kerbl et al. 2023."""

NEAREST = 0.2
"""A common target must be at least this fraction of the median depth away from the cameras."""

IN_FRONT = 0.9
"""At least this fraction of the cameras must have the target in front of them."""


def upright(cameras: Sequence[Camera], points: Float64[np.ndarray, "N 3"]) -> Similarity:
    """Find the transform to up (0, -1, 0), with the origin at the cameras' target and the cameras 5 units from it.

    Up is `gsplat_edu.paths.orbits.common_up`. The first camera looks along +z, except for its tilt. The origin is the
    point nearest to all optical axes. If these do not meet in front of the cameras, for example in a room photographed
    from its centre, the origin is the mean camera centre, and the median depth of the points becomes 5.

    Args:
        cameras: At least one.
        points: (N, 3) points seen by the cameras, world units; at least one.

    Raises:
        ArgumentError: there is no camera or no point.
    """
    if not cameras or not len(points):
        raise ArgumentError("cameras, points: one of them is empty; there is nothing to align")
    eyes = np.stack([camera.eye for camera in cameras])
    forwards = np.stack([camera.R[2] for camera in cameras])
    down = -common_up(cameras)
    # if the first camera looks straight up or down, the top of its image is forward
    ahead = next(
        level
        for axis in (forwards[0], -cameras[0].R[1], cameras[0].R[0])
        if np.linalg.norm(level := axis - (axis @ down) * down) > 0.1
    )
    ahead = ahead / np.linalg.norm(ahead)
    R = np.stack([np.cross(down, ahead), down, ahead])
    depth = _depth(cameras, points)
    centre = point_nearest_axes(cameras)
    if centre is not None:
        before = np.sum((centre - eyes) * forwards, axis=1) > 0
        distance = float(np.median(np.linalg.norm(eyes - centre, axis=1)))
    if centre is None or before.mean() < IN_FRONT or distance < NEAREST * depth:
        centre, distance = eyes.mean(axis=0), depth
    scale = DISTANCE / distance
    return Similarity(R, scale, -scale * (R @ centre))


def _depth(cameras: Sequence[Camera], points: Float64[np.ndarray, "N 3"]) -> float:
    """Return the median over cameras of the median depth of the points in their images."""
    some = points[:: max(1, len(points) // 5_000)]
    depths = []
    for camera in cameras:
        u, v, z = camera.project(camera.world_to_cam(some))
        inside = (z > 0) & (u >= -0.5) & (u <= camera.W - 0.5) & (v >= -0.5) & (v <= camera.H - 0.5)
        if inside.any():
            depths.append(float(np.median(z[inside])))
    return float(np.median(depths)) if depths else 1.0

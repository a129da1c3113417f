"""The box around what most photos look at: where the region of interest and the editor's box start."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from gsplat_edu.paths.orbits import common_up
from gsplat_edu.scene.region import Region
from gsplat_edu.survey.geometry import Geometry

MIDDLE = 0.5
"""Width and height of the middle of a photo, as fractions of its own."""

MOST_PHOTOS = 0.6
"""A point of the subject lies in the middle of at least this fraction of the photos."""

FEWEST = 20
"""Fewer such points give no box."""

ENDS = (0.02, 0.98)
"""Quantiles of the points along each edge that the box reaches to."""

MARGIN = 1.15
"""Factor on the box's extent."""

ELSEWHERE = 0.25
"""Half extent without such points, as a fraction of the distance between the cameras and what they look at."""


def subject_region(geometry: Geometry, up: Float64[np.ndarray, "3"] | None = None) -> Region:
    """Return an upright box around the points that most photos show in their middle.

    Args:
        geometry: The cameras and points, in whose coordinates the box is.
        up: (3,) up direction; None takes that of the cameras.
    """
    rotation = _upright(common_up(geometry.cameras) if up is None else up)
    points = geometry.some_points
    chosen = points[_in_the_middle(geometry, points)]
    if len(chosen) >= FEWEST:
        low, high = np.quantile(chosen @ rotation, ENDS, axis=0)
        half = np.maximum(MARGIN * (high - low) / 2.0, 1e-3 * float((high - low).max()) + 1e-9)
        return Region(rotation @ ((low + high) / 2.0), rotation, half)
    eyes = geometry.eyes
    center = np.median(points, axis=0) if len(points) else np.median(eyes, axis=0)
    center = center if geometry.centre is None else geometry.centre
    away = float(np.median(np.linalg.norm(eyes - center, axis=1)))
    return Region(center, rotation, np.full(3, ELSEWHERE * away or 1.0))


def _in_the_middle(geometry: Geometry, points: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Return which points most photos show in their middle."""
    shown = np.zeros(len(points))
    for camera in geometry.cameras:
        u, v, _ = camera.project(camera.world_to_cam(points))
        across, down = (np.abs(u - camera.W / 2) / camera.W, np.abs(v - camera.H / 2) / camera.H)
        shown += (across < MIDDLE / 2) & (down < MIDDLE / 2)  # NaN, behind a camera, is below nothing
    return np.asarray(shown >= MOST_PHOTOS * len(geometry.cameras))


def _upright(up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return a rotation whose second column points down."""
    down = -up / np.linalg.norm(up)
    level = np.eye(3)[np.argmin(np.abs(down))]
    x = np.cross(down, level)
    x = x / np.linalg.norm(x)
    return np.stack([x, down, np.cross(x, down)], axis=1)

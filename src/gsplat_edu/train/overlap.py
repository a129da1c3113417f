"""How much the views of a capture overlap: what few of them show needs Gaussians of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from gsplat_edu.scene.camera import Camera

MOST_VIEWS = 400
"""More views are thinned evenly."""

MOST_POINTS = 4_000
"""More points are thinned evenly."""

DIGITS = 2
"""Digits of the result, so that the last bits of a projection do not change a plan."""


def separate_views(cameras: Sequence[Camera], points: Float64[np.ndarray, "N 3"]) -> float:
    """Return how many views that show nothing in common would show as much as these.

    It is the number of views divided by the mean number of them that see a point, without regard to what hides it: 1
    if all see all points, and the number of views if each sees other ones.

    Args:
        cameras: The views.
        points: World units. Those that no view sees do not count.

    Returns:
        At least 1; 1 if no view sees a point.
    """
    cameras = [cameras[i] for i in _thinned(len(cameras), MOST_VIEWS)]
    points = points[_thinned(len(points), MOST_POINTS)]
    points = points[np.isfinite(points).all(axis=1)]
    seen = np.zeros(len(points), np.int64)
    for camera in cameras:
        u, v, _ = camera.project(camera.world_to_cam(points))
        inside = np.abs(u - (camera.W - 1) / 2) <= camera.W / 2  # not where it is NaN
        seen += inside & (np.abs(v - (camera.H - 1) / 2) <= camera.H / 2)
    shown = seen[seen > 0]
    if not len(shown):
        return 1.0
    separate = len(cameras) * len(shown) / int(shown.sum())
    return max(1.0, float(f"{separate:.{DIGITS}g}"))


def _thinned(count: int, most: int) -> np.ndarray:
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)

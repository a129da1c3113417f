"""Random start points for a capture without points: only places that at least two training photos see.

A point that a single photo sees fits at any depth, and a point that no photo sees never changes. Both would stay as a
coloured cloud.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.points import RANDOM_POINTS, random_cloud
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import point_nearest_axes, scene_extent, stray_eyes

LEAST_VIEWS = 2
"""A start point lies in at least this many photos, or in all of them if there are fewer."""

NEAREST, FARTHEST = 1.0, 5.0
"""Range of the depths from the camera, as multiples of the scene's size; the inverse of the depth is uniform. Nearer
points become floaters: from 0.3, 0.6, 1.0 and 1.5 on, `fox --resolution 6` scores 30.6, 30.5, 31.5 and 28.9 dB (2,000
iterations), a traced room whose walls lie beyond its cameras 18.9, 25.8, 29.2 and 29.7 (1,500)."""

TRIES = 40
"""Largest number of draws of `RANDOM_POINTS` candidates; a capture whose photos hardly overlap gets fewer points."""


def seen_by(
    points: Float64[np.ndarray, "N 3"], cameras: Sequence[Camera], least: int
) -> Bool[np.ndarray, " N"]:
    """Return which points lie in the images of at least some number of cameras.

    Args:
        points: (N, 3) world units.
        cameras: The cameras.
        least: The number.
    """
    counts = np.zeros(len(points), dtype=np.int64)
    for camera in cameras:
        local = camera.world_to_cam(points)
        if camera.projection.plain:
            x, y, z = np.moveaxis(local, -1, 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
                ahead = z > 0
        else:
            u, v, _ = camera.project(local)
            ahead = np.isfinite(u)
        with np.errstate(invalid="ignore"):
            counts += ahead & (u >= 0) & (u <= camera.W - 1) & (v >= 0) & (v <= camera.H - 1)
    return counts >= least


def cloud_in_cube(cameras: Sequence[Camera], centre: Float64[np.ndarray, "3"], half_edge: float) -> Cloud:
    """Draw points uniformly from the part of a cube that at least two photos see; every run draws the same ones.

    Args:
        cameras: Cameras of the training views.
        centre: (3,) centre of the cube, world units.
        half_edge: Half the length of its edge, world units.

    Returns:
        At most `RANDOM_POINTS` points; the whole cube if no photo looks there.
    """
    whole = random_cloud(centre, half_edge)
    seen = seen_by(whole.points, cameras, min(LEAST_VIEWS, len(cameras)))
    return Cloud(whole.points[seen], whole.colors[seen]) if seen.any() else whole


def cloud_in_view(cameras: Sequence[Camera]) -> Cloud | None:
    """Draw points that at least two photos see; every run draws the same ones.

    A point lies on the ray of a random pixel of a camera, in turn, at a depth whose inverse is uniform.

    Args:
        cameras: Cameras of the training views, at least one.

    Returns:
        At most `RANDOM_POINTS` points with random colours; None if no two photos see the same place.
    """
    rng = np.random.default_rng(0)
    size, least = _size(cameras), min(LEAST_VIEWS, len(cameras))
    found, total = list[np.ndarray](), 0
    for _ in range(TRIES):
        candidates = []
        for camera, count in zip(cameras, _shares(RANDOM_POINTS, len(cameras)), strict=True):
            u, v = rng.uniform(0, camera.W - 1, count), rng.uniform(0, camera.H - 1, count)
            z = 1.0 / rng.uniform(1.0 / (FARTHEST * size), 1.0 / (NEAREST * size), count)
            a, b = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
            if camera.projection.plain:
                local = np.stack([a * z, b * z, z], axis=1)
            else:
                local = camera.projection.directions(a, b, camera.widest) * z[:, None]
                local = local[np.isfinite(local).all(axis=1)]
            candidates.append(local @ camera.R + camera.eye)
        points = np.concatenate(candidates)
        found.append(points[seen_by(points, cameras, least)])
        total += len(found[-1])
        if total >= RANDOM_POINTS:
            break
    if not total:
        return None
    kept = np.concatenate(found)
    if total > RANDOM_POINTS:
        kept = kept[np.sort(rng.permutation(total)[:RANDOM_POINTS])]
    return Cloud(kept, rng.uniform(0.0, 1.0, (len(kept), 3)))


def _size(cameras: Sequence[Camera]) -> float:
    """Return the distance to what most cameras look at, but at least the extent of the cameras, world units."""
    stray = stray_eyes(np.stack([camera.eye for camera in cameras]))
    extent = scene_extent(cameras)
    focus = point_nearest_axes(
        [camera for camera, is_stray in zip(cameras, stray, strict=True) if not is_stray]
    )
    if focus is None:
        return extent
    depth = float(np.median([camera.world_to_cam(focus)[2] for camera in cameras]))
    return max(extent, depth)


def _shares(total: int, parts: int) -> list[int]:
    """Divide a number into parts that differ by at most one."""
    return [(i + 1) * total // parts - i * total // parts for i in range(parts)]

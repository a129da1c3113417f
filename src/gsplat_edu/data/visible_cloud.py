"""Points and the photos that see them: random start points, and those of scans.

Random ones are drawn only where at least two training photos look. A random point that a single photo sees fits at any
depth, and a point that no photo sees never changes. Both would stay as a coloured cloud.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.points import RANDOM_POINTS, random_cloud
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import point_nearest_axes, scene_extent, stray_eyes
from gsplat_edu.scene.views import View

LEAST_VIEWS = 2
"""A start point lies in at least this many photos, or in all of them if there are fewer."""

NEAREST, FARTHEST = 1.0, 5.0
"""Range of the depths from the camera, as multiples of the scene's size; the inverse of the depth is uniform. Nearer
points become floaters: from 0.3, 0.6, 1.0 and 1.5 on, `fox --resolution 6` scores 30.6, 30.5, 31.5 and 28.9 dB (2,000
iterations), a traced room whose walls lie beyond its cameras 18.9, 25.8, 29.2 and 29.7 (1,500)."""

STEPS = 12
"""Halvings in the search for the grid of `thinned`."""

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
        counts += in_image(points, camera)[0]
    return counts >= least


def in_image(
    points: Float64[np.ndarray, "N 3"], camera: Camera
) -> tuple[Bool[np.ndarray, " N"], Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    """Return which points lie in a camera's image, and their columns and rows there, px.

    Args:
        points: (N, 3) world units.
        camera: The camera.
    """
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
        return ahead & (u >= 0) & (u <= camera.W - 1) & (v >= 0) & (v <= camera.H - 1), u, v


def thinned(points: Float64[np.ndarray, "N 3"], most: int) -> Int64[np.ndarray, " M"]:
    """Choose points evenly in space: the first one in each cell of the finest grid that leaves few enough.

    Args:
        points: (N, 3) finite, any units.
        most: Largest number of points.

    Returns:
        Their indices, ascending; all if there are not more.
    """
    if len(points) <= most:
        return np.arange(len(points))
    low = points.min(axis=0)
    edge = float((points.max(axis=0) - low).max()) or 1.0
    fine, coarse = (
        0.0,
        1.0,
    )  # the logarithm of the number of cells along the longest edge, as a share of 20 bits
    chosen = np.zeros(1, np.int64)
    for _ in range(STEPS):
        share = (fine + coarse) / 2.0
        cells = np.minimum((points - low) * (2.0 ** (20.0 * share) / edge), 2.0**20 - 1).astype(np.int64)
        found = np.unique((cells[:, 0] << 40) | (cells[:, 1] << 20) | cells[:, 2], return_index=True)[1]
        if len(found) <= most:
            fine, chosen = share, found
        else:
            coarse = share
    return np.sort(chosen)


def colored(points: Float64[np.ndarray, "N 3"], views: Sequence[View]) -> Float64[np.ndarray, "N 3"]:
    """Colour points by photos: each takes the pixel of the nearest camera that has it in its image.

    What hides a point is not known; it seldom stands before the nearest camera.

    Args:
        points: (N, 3) world units.
        views: Views with photos.

    Returns:
        Colours, 0 to 1; grey for points that no photo shows.
    """
    nearest, of = np.full(len(points), np.inf), np.full(len(points), -1)
    for number, view in enumerate(views):
        distance = np.linalg.norm(points - view.camera.eye, axis=1)
        closer = in_image(points, view.camera)[0] & (distance < nearest)
        nearest[closer], of[closer] = distance[closer], number
    colors = np.full((len(points), 3), 0.5)
    for number, view in enumerate(views):
        mine = np.flatnonzero(of == number)
        if len(mine):
            _, u, v = in_image(points[mine], view.camera)
            image = view.read().image
            scale = 255.0 if image.dtype == np.uint8 else 1.0
            colors[mine] = image[np.rint(v).astype(int), np.rint(u).astype(int)] / scale
    return colors


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

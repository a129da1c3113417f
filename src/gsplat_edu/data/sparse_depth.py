"""Sparse depth of a capture's photos: the points that COLMAP triangulated, by the photos in whose tracks they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import is_file
from gsplat_edu.data.chosen_poses import chosen_poses
from gsplat_edu.data.colmap import SUFFIXES, find_model, points_file
from gsplat_edu.data.colmap_files import (
    Tracked,
    observations_bin,
    observations_txt,
    tracked_bin,
    tracked_txt,
)
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.given_depth import GivenDepth

MAX_ERROR = 2.5
"""Largest reprojection error of a point whose depth counts, px."""

LEAST_VIEWS = 3
"""A point that fewer photos see has no certain depth."""


class TrackedPoints(NamedTuple):
    """The points of a model that are good enough to give depth."""

    points: Float64[np.ndarray, "N 3"]  # world units, in the capture's coordinates
    seen: Mapping[
        str, Int64[np.ndarray, " n"]
    ]  # rows of the points in each photo's tracks, by the photo's name


def tracked_points(
    folder: Path, most_error: float = MAX_ERROR, least_views: int = LEAST_VIEWS
) -> TrackedPoints | None:
    """Read the tracks of a COLMAP model.

    Points with a larger error, in fewer photos or with NaN are left out. The tracks of
    captures that this project writes were computed from poses and points, which is as good for depth.

    Args:
        folder: The capture.
        most_error: Largest reprojection error, px.
        least_views: Smallest number of photos that see a point.

    Returns:
        The points; None if there is no model, or it has no points.

    Raises:
        DatasetError: a file is truncated or malformed.
    """
    model = find_model(chosen_poses(folder))
    listed = (
        None if model is None else next((f for s in SUFFIXES if is_file(f := model / f"images{s}")), None)
    )
    points = None if model is None else points_file(model)
    if listed is None or points is None:
        return None
    tracked = tracked_bin(points) if points.suffix == ".bin" else tracked_txt(points)
    images = observations_bin(listed) if listed.suffix == ".bin" else observations_txt(listed)
    order = np.argsort(tracked.numbers, kind="stable")
    seen = {legible(image.name): _rows(tracked, order, image.points) for image in images}
    views = np.zeros(len(order), np.int64)
    for rows in seen.values():
        views[rows] += 1
    good = (
        (tracked.errors <= most_error) & (views >= least_views) & np.isfinite(tracked.positions).all(axis=1)
    )
    if not good.any():
        return None
    new = np.cumsum(good) - 1
    return TrackedPoints(
        tracked.positions[good], {name: new[rows[good[rows]]] for name, rows in seen.items()}
    )


def _rows(
    tracked: Tracked, order: Int64[np.ndarray, " N"], numbers: Int64[np.ndarray, " n"]
) -> Int64[np.ndarray, " m"]:
    """Return the rows of points by their numbers, each once; numbers that no point has are left out."""
    numbers = np.unique(numbers)
    at = np.searchsorted(tracked.numbers[order], numbers)
    there = at < len(order)
    rows = order[at[there]]
    found: Int64[np.ndarray, " m"] = rows[tracked.numbers[rows] == numbers[there]]
    return found


def sparse_depth(
    camera: Camera, points: Float64[np.ndarray, "n 3"], *, triangulated: bool = True
) -> GivenDepth:
    """Return the depth of points in a photo that sees them; points that its lens does not see are left out.

    Args:
        camera: The photo's camera, of any projection and shutter.
        points: World units, in the camera's coordinate frame.
        triangulated: Whether photos gave the points, and not a scanner.
    """
    if not camera.pinhole:
        seen = camera.sight(points)
        u, v, valid = seen.u, seen.v, np.asarray(seen.valid)
        inside = valid & (v >= 0) & (v <= camera.H - 1)
        if not camera.projection.wraps:
            inside &= (u >= 0) & (u <= camera.W - 1)
        places = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=1)
        return GivenDepth(places[inside], np.asarray(seen.depth)[inside], sparse=triangulated)
    at = camera.world_to_cam(points)
    at = at[at[:, 2] > 0]
    rays, z = at[:, :2] / at[:, 2:], at[:, 2]
    u, v = camera.fx * rays[:, 0] + camera.cx, camera.fy * rays[:, 1] + camera.cy
    inside = (u >= 0) & (u <= camera.W - 1) & (v >= 0) & (v <= camera.H - 1)
    return GivenDepth(rays[inside], z[inside], sparse=triangulated)

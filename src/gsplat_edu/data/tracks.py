"""Find the points that each photo sees, for the tracks of a COLMAP model that was not made from matches.

A photo sees a point if its lens does (a pinhole: what is before it), the point is inside the image, and not hidden: a
point hides farther points in its cell of the image. Cells are large enough to contain some points of an evenly covered
surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.scene.camera import Camera

MOST_SEEN = 2_000
"""Largest number of points per photo, evenly spaced in the order of the points: about as many as matching finds. A
cloud of a million points in hundreds of photos would make gigabytes of tracks."""

PER_CELL = 4
"""Points of a cell on average."""

UNMEASURED = -1.0
"""Reprojection error of points whose tracks come from here: COLMAP's value for an error that was not computed. It means
that the tracks are no evidence for the poses, because they were computed from them."""

DEPTH_SLACK = 0.05
"""A point is hidden if it is farther away than the nearest one of its cell by more than this fraction. Surfaces seen at
a grazing angle lose points, which is harmless."""


class VisiblePoints(NamedTuple):
    """The points that a photo sees."""

    points: Int64[np.ndarray, " M"]
    """Rows of the points, increasing."""
    pixels: Float64[np.ndarray, "M 2"]
    """Their positions, px; the centre of the first pixel is at (0.5, 0.5), as in COLMAP's files."""


class Track(NamedTuple):
    """The observations of a point."""

    images: Int64[np.ndarray, " L"]
    """Indices of the cameras."""
    places: Int64[np.ndarray, " L"]
    """Rows of the point in the `VisiblePoints` of those cameras."""


def visible_points(
    camera: Camera, points: Float64[np.ndarray, "N 3"], most: int = MOST_SEEN
) -> VisiblePoints:
    """Return the points that a camera sees, with occlusion by other points; at most some number of them."""
    if camera.pinhole:
        at = camera.world_to_cam(points)
        before = np.flatnonzero(at[:, 2] > 0)
        u, v, depth = camera.project(at[before])
    else:
        sight = camera.sight(points)
        before = np.flatnonzero(sight.valid)
        u, v, depth = (np.asarray(each)[before] for each in (sight.u, sight.v, sight.depth))
    inside = (u >= -0.5) & (u < camera.W - 0.5) & (v >= -0.5) & (v < camera.H - 0.5)
    rows, u, v, depth = before[inside], u[inside], v[inside], depth[inside]
    edge = max(1.0, float(np.sqrt(PER_CELL * camera.W * camera.H / max(len(rows), 1))))
    columns = int(camera.W // edge) + 1
    cells = ((v + 0.5) // edge).astype(np.int64) * columns + ((u + 0.5) // edge).astype(np.int64)
    nearest = np.full(cells.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, cells, depth)
    shown = np.flatnonzero(depth <= (1 + DEPTH_SLACK) * nearest[cells])
    if len(shown) > most:
        shown = shown[np.linspace(0, len(shown) - 1, most).round().astype(np.int64)]
    return VisiblePoints(rows[shown], np.stack([u, v], axis=-1)[shown] + 0.5)


def tracks_of(seen: Sequence[VisiblePoints], count: int) -> list[Track]:
    """Return the track of each of `count` points: by image, then by place."""
    points = np.concatenate([each.points for each in seen] or [np.empty(0, np.int64)])
    images = np.repeat(np.arange(len(seen)), [len(each.points) for each in seen])
    places = np.concatenate([np.arange(len(each.points)) for each in seen] or [np.empty(0, np.int64)])
    order = np.argsort(points, kind="stable")
    ends = np.bincount(points, minlength=count).cumsum()[:-1]
    split = zip(np.split(images[order], ends), np.split(places[order], ends), strict=True)
    return [Track(*each) for each in split][:count]

"""Cut polygons in space into triangles, whether they are convex or not, flat or not.

A polygon whose corners are all visible from the first, as in a convex one, becomes a fan. Any other one gets the
triangles of least total area, found by dynamic programming. In a flat polygon that area is the polygon's own exactly if
no triangle lies outside or on another one.

Source: Barequet and Sharir 1995, "Filling gaps in the boundary of a polyhedron": the dynamic programme.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64, Int64

LONG_EDGE = 1e-6
"""Weight of the squared lengths of new edges against the area; it decides among triangulations of equal area."""


def area_vector(ring: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "3"]:
    """Return the normal of a polygon, as long as twice its area (Newell's sum).

    Args:
        ring: (N, 3) its corners in order.
    """
    centred = ring - ring.mean(axis=0)
    return np.asarray(np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0))


def has_plain_fan(ring: Float64[np.ndarray, "N 3"]) -> bool:
    """Return whether every triangle of the fan from corner 0 faces the same way as the polygon.

    Args:
        ring: (N, 3) its corners in order.
    """
    arms = ring[1:] - ring[0]
    return bool((np.cross(arms[:-1], arms[1:]) @ area_vector(ring) > 0.0).all())


def triangles_of(ring: Float64[np.ndarray, "N 3"]) -> Int64[np.ndarray, "M 3"]:
    """Cut a polygon into triangles of the same orientation.

    Args:
        ring: (N, 3) its corners in order, at least 3.

    Returns:
        (N - 2, 3) indices of corners.
    """
    if has_plain_fan(ring):
        after = np.arange(1, len(ring) - 1)
        return np.stack([np.zeros_like(after), after, after + 1], axis=1)
    found = least_area_triangles(ring, lambda _, __: True)
    assert found is not None  # every edge is allowed
    return found


def least_area_triangles(
    ring: Float64[np.ndarray, "N 3"], allowed: Callable[[int, int], bool]
) -> Int64[np.ndarray, "M 3"] | None:
    """Return the triangulation of a polygon with the least area.

    Takes a time that grows with N³, most of it in NumPy: 0.01 s for 30 corners.

    Args:
        ring: (N, 3) its corners in order, at least 3.
        allowed: Called with two corners i < j that are no neighbours: whether triangles may have the edge between them.

    Returns:
        (N - 2, 3) indices of corners, in the polygon's orientation; None if the allowed edges do not suffice.
    """
    count = len(ring)
    cost = np.zeros((count, count))  # of the part between corners i and j
    middle = np.zeros((count, count), dtype=np.int64)
    for gap in range(2, count):
        starts = np.arange(count - gap)
        if gap < count - 1:
            closed = np.array([not allowed(first, first + gap) for first in range(count - gap)])
            cost[starts[closed], starts[closed] + gap] = np.inf
            starts = starts[~closed]
        if not len(starts):
            continue
        ends, between = starts + gap, starts[:, None] + np.arange(1, gap)
        chord = ring[ends] - ring[starts]
        (x, y, z), (u, v, w) = np.moveaxis(ring[between] - ring[starts, None], -1, 0), chord.T[..., None]
        areas = np.sqrt((y * w - z * v) ** 2 + (z * u - x * w) ** 2 + (x * v - y * u) ** 2)
        total = cost[starts[:, None], between] + cost[between, ends[:, None]] + 0.5 * areas
        best = total.argmin(axis=1)
        rows = np.arange(len(starts))
        cost[starts, ends] = total[rows, best] + LONG_EDGE * (chord**2).sum(axis=1)
        middle[starts, ends] = between[rows, best]
    if not np.isfinite(cost[0, count - 1]):
        return None
    triangles, parts = [], [(0, count - 1)]
    while parts:
        i, j = parts.pop()
        if j - i < 2:
            continue
        k = int(middle[i, j])
        triangles.append((i, k, j))
        parts += [(i, k), (k, j)]
    return np.array(triangles, dtype=np.int64)

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
        for i in range(count - gap):
            j = i + gap
            if gap < count - 1 and not allowed(i, j):
                cost[i, j] = np.inf
                continue
            between = np.arange(i + 1, j)
            areas = np.linalg.norm(np.cross(ring[between] - ring[i], ring[j] - ring[i]), axis=1)
            total = cost[i, between] + cost[between, j] + 0.5 * areas
            best = int(total.argmin())
            cost[i, j] = total[best] + LONG_EDGE * float(((ring[j] - ring[i]) ** 2).sum())
            middle[i, j] = between[best]
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

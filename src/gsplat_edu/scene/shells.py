"""Find points that form a shell far behind all others, as splats of a sky do.

Files do not mark them. Functions that need the size of a scene, or positions as fractions of it, call this module.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

BOUND_STEP, FIRST_BOUND, LAST_BOUND = 1.25, 4, 60
"""Radii that may bound the others: the median distance times 1.25^4 to 1.25^60."""

GAP = 3.0
"""Between the bound and this multiple of it lie"""
STRAYS = 0.005
"""at most this share of the points;"""
LEAST = 0.005
"""beyond it, at least this share,"""
THICKNESS = 1.5
"""90 % of which lie within this factor of distance."""


def far_shell(points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Find a shell of points that is far behind the others.

    Args:
        points: (N, 3) world units; not finite ones are never part of a shell.

    Returns:
        (N,) true for the points of the shell; all false if there is none.
    """
    none = np.zeros(len(points), dtype=bool)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        return none
    away = points.astype(np.float64) - np.median(points[finite], axis=0)
    distances = np.where(finite, np.sqrt(np.square(away).sum(axis=1)), 0.0)
    ranked = np.sort(distances[finite])
    bounds = ranked[len(ranked) // 2] * BOUND_STEP ** np.arange(FIRST_BOUND, LAST_BOUND)
    inner, outer = np.searchsorted(ranked, bounds, "right"), np.searchsorted(ranked, GAP * bounds, "right")
    for start, end, bound in reversed(list(zip(inner, outer, bounds, strict=True))):
        if end - start > STRAYS * len(ranked) or len(ranked) - end < LEAST * len(ranked):
            continue
        low, high = np.quantile(ranked[end:], (0.05, 0.95))
        if high <= THICKNESS * low:
            return np.asarray(distances > bound)
    return none

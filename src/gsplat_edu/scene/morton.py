"""Orders points along a Morton curve, so that neighbours in space are mostly neighbours in memory."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64, UInt16, UInt64

OUTSIDE = 0.01
"""Fraction of the points on each side of each axis that may lie outside the grid, so that strays do not coarsen it."""

SAMPLE = 4096
"""The grid is fitted to about this many of the points."""

FARTHEST = 1e30
"""Coordinates beyond it count as this far, world units, so that differences and ratios stay finite."""


def morton_codes(cells: UInt16[np.ndarray, "N 3"]) -> UInt64[np.ndarray, " N"]:
    """Interleave the bits of z, y and x.

    Args:
        cells: N cells of a grid.

    Returns:
        Their numbers along the curve.
    """
    spread = cells.astype(np.uint64)
    for shift, mask in (
        (16, 0x0000FF0000FF),
        (8, 0x00F00F00F00F),
        (4, 0x0C30C30C30C3),
        (2, 0x249249249249),
    ):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    codes: UInt64[np.ndarray, " N"] = (
        spread[:, 0] | spread[:, 1] << np.uint64(1) | spread[:, 2] << np.uint64(2)
    )
    return codes


def order_in_space(points: Float[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Sort points along a Morton curve through a grid of cubes. Points outside the grid count as on its boundary.

    Args:
        points: N positions, world units. NaN counts as 0.

    Returns:
        Their indices in that order; points of the same cube keep their order.
    """
    if not len(points):
        return np.arange(0)
    finite = np.clip(np.nan_to_num(points.astype(np.float64), nan=0.0), -FARTHEST, FARTHEST)
    low, high = np.quantile(finite[:: 1 + len(finite) // SAMPLE], (OUTSIDE, 1 - OUTSIDE), axis=0)
    size = max((high - low).max(), 1 / FARTHEST)
    cells = np.clip((finite - low) / size, 0.0, 1.0) * np.iinfo(np.uint16).max
    return np.argsort(morton_codes(cells.astype(np.uint16)), kind="stable")

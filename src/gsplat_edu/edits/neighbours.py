"""Splats near those of a set, by a hash of cells: exactly as in `viewer/web/edit_near.js`.

`grow` and `shrink` change the selection where a splat lies within a radius of another one. For the centres p and q,

    (a a + b b) + c c <= radius radius,    (a, b, c) = p - q,

in float64 and in this order, so both languages find the same splats. The cells only decide which pairs are compared.
Their side is a little longer than the radius, so two centres within the radius never lie more than one cell apart,
whatever the rounding. Cells are counted from the median of the set along each axis. Centres more than `HALF` cells away
belong to the outermost cells: moving them there brings no two cells further apart.

Both languages count the same tests: every splat with every one of the set in the 27 cells around it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.edits.cells import EditWork

HALF = 1 << 16
"""Cells along each axis on either side of the median; the number of a cell then fits in 53 bits."""

WIDER = 1.001
"""Side of a cell, in radii. The excess is far above the rounding of cell coordinates, at most 2^-36."""

MOST_PAIRS = 10**9
"""Tests that one `grow` or `shrink` may take, a tenth of those of a whole file: no single step takes minutes."""

AT_ONCE = 1 << 21
"""Pairs that are compared at once, to bound the memory."""

Centres = Float64[np.ndarray, "N 3"]
Mask = Bool[np.ndarray, " N"]


def within_radius(means: Centres, some: Mask, others: Mask, radius: float, work: EditWork) -> Mask:
    """Return which splats of `some` lie within a radius of a splat of `others`.

    Args:
        means: (N, 3) centres, world units. A splat whose centre is not finite is near nothing.
        some: (N,) splats to judge.
        others: (N,) splats that they are compared with.
        radius: World units.
        work: Counts one test for each of the N splats, and one for each pair in neighbouring cells.

    Raises:
        ArgumentError: it would take too many tests; raised before they are made.
    """
    work.add(len(means))
    finite = np.isfinite(means).all(axis=1)
    judged, near = np.flatnonzero(some & finite), np.flatnonzero(others & finite)
    found = np.zeros(len(means), dtype=bool)
    if not len(judged) or not len(near):
        return found
    middle = np.sort(means[near], axis=0)[len(near) // 2]
    side = WIDER * radius
    cells, places = (_cells(means[rows], middle, side) for rows in (near, judged))
    order = np.argsort(_numbers(cells), kind="stable")
    near, numbers = near[order], _numbers(cells)[order]
    order = np.argsort(_numbers(places), kind="stable")
    judged, places = judged[order], places[order]
    begins, ends = _ranges(numbers, places)
    pairs = int((ends - begins).sum())
    if pairs > MOST_PAIRS:
        raise ArgumentError(
            f"edits: a radius of {radius:g} takes {pairs:,} tests of a splat, but {MOST_PAIRS:,} are allowed;"
            " give a smaller radius"
        )
    work.add(pairs)
    square = radius * radius
    for begin, end in zip(begins, ends, strict=True):
        left = ~found[judged]
        _compare(means, judged[left], near, (begin[left], end[left]), square, found)
    return found


def _cells(points: Centres, middle: Float64[np.ndarray, " 3"], side: float) -> Int64[np.ndarray, "N 3"]:
    """Return the cell of each point along each axis, from 0 to 2 HALF - 1."""
    placed = np.clip(np.floor((points - middle) / side), -HALF, HALF - 1)
    cells: Int64[np.ndarray, "N 3"] = placed.astype(np.int64) + HALF
    return cells


def _numbers(cells: Int64[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the number of each cell; those of a row along x follow one another."""
    x, y, z = cells.T
    numbers: Int64[np.ndarray, " N"] = (z * (2 * HALF) + y) * (2 * HALF) + x
    return numbers


def _ranges(
    numbers: Int64[np.ndarray, " M"], places: Int64[np.ndarray, "K 3"]
) -> tuple[Int64[np.ndarray, "9 K"], Int64[np.ndarray, "9 K"]]:
    """Return where the splats in the cells around each place begin and end in sorted numbers, for nine rows."""
    begins, ends = (np.zeros((9, len(places)), dtype=np.int64) for _ in range(2))
    low, high = np.maximum(places[:, 0] - 1, 0), np.minimum(places[:, 0] + 1, 2 * HALF - 1)
    for k in range(9):
        y, z = places[:, 1] + k % 3 - 1, places[:, 2] + k // 3 - 1
        exists = (y >= 0) & (y < 2 * HALF) & (z >= 0) & (z < 2 * HALF)
        row = (z * (2 * HALF) + y) * (2 * HALF)
        begins[k] = np.where(exists, np.searchsorted(numbers, row + low), 0)
        ends[k] = np.where(exists, np.searchsorted(numbers, row + high, side="right"), 0)
    return begins, ends


def _compare(
    means: Centres,
    judged: Int64[np.ndarray, " K"],
    near: Int64[np.ndarray, " M"],
    ranges: tuple[Int64[np.ndarray, " K"], Int64[np.ndarray, " K"]],
    square: float,
    found: Mask,
) -> None:
    """Compare each judged splat with those of a range, and mark those that are found."""
    begins, ends = ranges
    counts = ends - begins
    upto = np.concatenate([[0], np.cumsum(counts)])
    first = 0
    while first < len(judged):
        last = max(int(np.searchsorted(upto, upto[first] + AT_ONCE, side="right")) - 1, first + 1)
        some = counts[first:last]
        rows = np.repeat(judged[first:last], some)
        starts = np.repeat(begins[first:last] - (upto[first:last] - upto[first]), some)
        other = near[starts + np.arange(len(rows))]
        a, b, c = (means[rows, i] - means[other, i] for i in range(3))
        found[rows[(a * a + b * b) + c * c <= square]] = True
        first = last

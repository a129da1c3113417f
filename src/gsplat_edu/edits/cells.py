"""Points of a picture in the cells of a grid, and a budget of tests, exactly as in `viewer/web/edit_cells.js`.

A lasso or a stroke of many points is compared only with the splats in the cells that each edge or segment touches. Both
sides build the same cells by the same operations on float64 numbers, so both count the same number of tests and refuse
the same file.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.base.errors import ArgumentError

SIDE = 64
"""Cells along each axis."""

MOST_TESTS = 10**10
"""Tests of a splat that a list of operations may take: 200 s for the slowest kind, a lasso of random points, of which a
test took 20 ns on one core of a Zen 5."""

Column = Float64[np.ndarray, " N"]
Indices = Int64[np.ndarray, " K"]


class EditWork:
    """Counts the tests of a list of operations.

    Args:
        most: Largest number of tests.
    """

    def __init__(self, most: int = MOST_TESTS) -> None:
        self.left = most

    def add(self, tests: int) -> None:
        """Count tests that are about to be made.

        Raises:
            ArgumentError: there are too many.
        """
        self.left -= tests
        if self.left < 0:
            raise ArgumentError(
                f"edits: the operations take more than {MOST_TESTS:,} tests of a splat; use fewer or shorter strokes,"
                " or convert the scene with the first operations and edit the result"
            )


class Cells:
    """N points of a picture by the cell of a grid over their bounds.

    Args:
        u: (N,) columns, px; finite.
        v: (N,) rows, px; finite.
        work: Counts the points that `touched` returns.
    """

    def __init__(self, u: Column, v: Column, work: EditWork) -> None:
        self._work = work
        self._u, self._v = _axis(u), _axis(v)
        cells = _place(v, self._v) * SIDE + _place(u, self._u)
        self._order = np.argsort(cells, kind="stable")
        self._starts = np.concatenate([[0], np.cumsum(np.bincount(cells, minlength=SIDE * SIDE))])

    def touched(self, low_u: float, high_u: float, low_v: float, high_v: float, margin: int = 0) -> Indices:
        """Return the points in the cells that a rectangle touches, row by row.

        Args:
            low_u: Smallest column, px.
            high_u: Largest column, px.
            low_v: Smallest row, px.
            high_v: Largest row, px.
            margin: Further columns of cells on the right.

        Raises:
            ArgumentError: the work is too much.
        """
        left, right = _place(np.array([low_u, high_u]), self._u).tolist()
        top, bottom = _place(np.array([low_v, high_v]), self._v).tolist()
        first, last = SIDE * np.arange(top, bottom + 1) + left, min(right + margin, SIDE - 1) - left + 1
        begins, ends = self._starts[first], self._starts[first + last]
        self._work.add(int((ends - begins).sum()))
        return np.concatenate([self._order[a:b] for a, b in zip(begins, ends, strict=True)])


def _axis(values: Column) -> tuple[float, float]:
    """Return the smallest value, and cells per px."""
    if not len(values):
        return 0.0, 0.0
    low, high = float(values.min()), float(values.max())
    scale = SIDE / (high - low) if high > low else 0.0
    return low, scale if math.isfinite(scale) else 0.0


def _place(values: Column, axis: tuple[float, float]) -> Indices:
    """Return the cell along an axis; -inf and inf lie in the outermost ones."""
    low, scale = axis
    if scale == 0.0:
        return np.zeros(values.shape, dtype=np.int64)
    return np.clip(np.floor((values - low) * scale), 0, SIDE - 1).astype(np.int64)

"""Limit a selection in a picture to its front: exactly as in the page (`viewer/web/edit_front.js`).

The page measures the depth of the visible surface once, when the user draws, and the operation stores the result as a
grid of depths. Applying the file only compares numbers, so both sides hold the same splats to the last one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.records import Record
from gsplat_edu.paths.keyframes import FARTHEST

if TYPE_CHECKING:
    from jaxtyping import Bool

    from gsplat_edu.edits.cells import Column, EditWork

FARTHEST_PIXEL = 1e6
"""px: coordinates in a picture are at most this."""

MOST_CELLS = 64
"""Cells of the grid along each axis."""

NARROWEST = 1e-3
"""px: smallest extent of the grid's bounds along each axis, so that cells per px stay finite."""


Pixel = Annotated[float, Meta(ge=-FARTHEST_PIXEL, le=FARTHEST_PIXEL)]
Cells = Annotated[int, Meta(ge=1, le=MOST_CELLS)]


class Front(Record, frozen=True):
    """The largest camera depth that a selection holds, by the cell of a grid over a part of the picture.

    Args:
        bounds: (u0, v0, u1, v1), px. A centre outside of them belongs to the nearest cell.
        columns: Cells along u.
        rows: Cells along v.
        deepest: The depths of `rows` times `columns` cells, row by row, world units; None if there is no limit.
    """

    bounds: tuple[Pixel, Pixel, Pixel, Pixel]
    columns: Cells
    rows: Cells
    deepest: Annotated[
        tuple[Annotated[float, Meta(ge=0.0, le=FARTHEST)] | None, ...], Meta(max_length=MOST_CELLS**2)
    ]

    def __post_init__(self) -> None:
        """Check what the values have to be together."""
        u0, v0, u1, v1 = self.bounds
        if u1 - u0 < NARROWEST or v1 - v0 < NARROWEST:
            raise ArgumentError(f"bounds: u1, v1 must exceed u0, v0 by at least {NARROWEST:g}")
        if len(self.deepest) != self.columns * self.rows:
            raise ArgumentError(
                f"deepest: has {len(self.deepest)} depths, but {self.rows} rows of {self.columns} columns are"
                f" {self.columns * self.rows}"
            )


def in_front(front: Front, u: Column, v: Column, z: Column, work: EditWork) -> Bool[np.ndarray, " N"]:
    """Return which of N splats are at most as deep as their cells allow.

    Args:
        front: The grid.
        u: (N,) columns of their centres, px; finite.
        v: (N,) rows, px; finite.
        z: (N,) camera depths, world units.
        work: Counts one test for each of these splats.

    Raises:
        ArgumentError: the work is too much.
    """
    work.add(len(u))
    u0, v0, u1, v1 = front.bounds
    column = _cell(u, u0, u1, front.columns)
    row = _cell(v, v0, v1, front.rows)
    deepest = np.array([np.inf if depth is None else depth for depth in front.deepest])
    within: Bool[np.ndarray, " N"] = z <= deepest[row * front.columns + column]
    return within


def _cell(values: Column, low: float, high: float, count: int) -> np.ndarray:
    """Return the cell along an axis: floor((value - low) (count / (high - low))), at least 0 and below the count."""
    return np.clip(np.floor((values - low) * (count / (high - low))), 0, count - 1).astype(np.int64)

"""Limit a selection in a picture to its front: exactly as in the page (`viewer/web/edit_front.js`).

The page measures the depth of the visible surface once, when the user draws, and the operation stores the result as a
grid of depths. Applying the file only compares numbers, so both sides hold the same splats to the last one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.json_fields import (
    check_keys,
    checked_list,
    checked_object,
    checked_whole,
    number_within,
    numbers_within,
)

if TYPE_CHECKING:
    from jaxtyping import Bool

    from gsplat_edu.edits.cells import Column, EditWork

MOST_CELLS = 64
"""Cells of the grid along each axis."""

NARROWEST = 1e-3
"""px: smallest extent of the grid's bounds along each axis, so that cells per px stay finite."""


@dataclass(frozen=True)
class Front:
    """The largest camera depth that a selection holds, by the cell of a grid over a part of the picture.

    Args:
        bounds: (u0, v0, u1, v1), px. A centre outside of them belongs to the nearest cell.
        columns: Cells along u.
        rows: Cells along v.
        deepest: The depths of `rows` times `columns` cells, row by row, world units; None if there is no limit.
    """

    bounds: tuple[float, ...]
    columns: int
    rows: int
    deepest: tuple[float | None, ...]


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


def parsed_front(where: str, value: object, most_pixel: float, most_depth: float) -> Front:
    """Parse the "front" of a selection.

    Args:
        where: Its place in the file, for messages.
        value: The parsed JSON.
        most_pixel: Largest coordinate of the bounds, px.
        most_depth: Largest depth, world units.

    Raises:
        ArgumentError: a value is invalid; the message names the place.
    """
    entry = checked_object(where, value)
    check_keys(f"{where}: ", entry, ("bounds", "columns", "rows", "deepest"))
    u0, v0, u1, v1 = numbers_within(f"{where}.bounds", entry["bounds"], 4, most_pixel)
    if u1 - u0 < NARROWEST or v1 - v0 < NARROWEST:
        raise ArgumentError(f"{where}.bounds: u1, v1 must exceed u0, v0 by at least {NARROWEST:g}")
    columns, rows = (
        checked_whole(f"{where}.{key}", entry[key], 1, MOST_CELLS) for key in ("columns", "rows")
    )
    cells = checked_list(f"{where}.deepest", entry["deepest"], MOST_CELLS * MOST_CELLS)
    if len(cells) != columns * rows:
        raise ArgumentError(
            f"{where}.deepest: has {len(cells)} depths, but {rows} rows of {columns} columns are {columns * rows}"
        )
    deepest = tuple(
        None if cell is None else number_within(f"{where}.deepest[{i}]", cell, 0.0, most_depth)
        for i, cell in enumerate(cells)
    )
    return Front((u0, v0, u1, v1), columns, rows, deepest)

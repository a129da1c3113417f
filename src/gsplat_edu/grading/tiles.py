"""Assignment 4: which tiles a splat touches, and the lists of the tiles.

It follows chapter 11.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsplat_edu.grading.assignment import Answer, Part


def _range_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    width, height, tile = 100, 70, 16
    inside = [
        (*draws.uniform([20, 20], [80, 50]), draws.uniform(3, 15), width, height, tile) for _ in range(6)
    ]
    across = [(draws.uniform(-5, 5), draws.uniform(60, 75), 12.5, width, height, tile) for _ in range(3)]
    return [
        *inside,
        *across,
        (32.0, 16.0, 0.0, width, height, tile),
        (300.0, -40.0, 9.0, width, height, tile),
    ]


def _tile_range(
    u: float, v: float, radius: float, width: int, height: int, tile: int
) -> tuple[int, int, int, int]:
    """Return first column, first row, column and row behind the last; empty ranges are (0, 0, 0, 0)."""
    left, top = max(math.ceil(u - radius), 0), max(math.ceil(v - radius), 0)
    right, bottom = min(math.floor(u + radius), width - 1), min(math.floor(v + radius), height - 1)
    if left > right or top > bottom:
        return 0, 0, 0, 0
    return left // tile, top // tile, right // tile + 1, bottom // tile + 1


def _last_included(
    u: float, v: float, radius: float, width: int, height: int, tile: int
) -> tuple[int, int, int, int]:
    x0, y0, x1, y1 = _tile_range(u, v, radius, width, height, tile)
    return (x0, y0, x1 - 1, y1 - 1) if x1 > x0 else (0, 0, 0, 0)


def _unclipped(
    u: float, v: float, radius: float, width: int, height: int, tile: int
) -> tuple[int, int, int, int]:
    far = 10_000 * tile
    x0, y0, x1, y1 = _tile_range(u + far, v + far, radius, 3 * far, 3 * far, tile)
    return x0 - 10_000, y0 - 10_000, x1 - 10_000, y1 - 10_000


def _swapped(
    u: float, v: float, radius: float, width: int, height: int, tile: int
) -> tuple[int, int, int, int]:
    x0, y0, x1, y1 = _tile_range(u, v, radius, width, height, tile)
    return y0, x0, y1, x1


def _pair_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    cases = []
    for count, columns in ((1, 4), (5, 7), (12, 9)):
        first = draws.integers(0, columns - 3, (count, 2))
        cases.append((np.concatenate([first, first + draws.integers(1, 4, (count, 2))], axis=1), columns))
    return cases


def _pairs(ranges: np.ndarray, columns: int) -> Answer:
    found = [
        (row * columns + column, splat)
        for splat, (x0, y0, x1, y1) in enumerate(np.asarray(ranges).tolist())
        for row in range(y0, y1)
        for column in range(x0, x1)
    ]
    return np.array(sorted(found))


def _by_splat(ranges: np.ndarray, columns: int) -> Answer:
    pairs = _pairs(ranges, columns)
    return pairs[np.lexsort((pairs[:, 0], pairs[:, 1]))]


def _by_columns(ranges: np.ndarray, columns: int) -> Answer:
    return _pairs(np.asarray(ranges)[:, [1, 0, 3, 2]], columns)


def _start_cases(draws: np.random.Generator) -> Sequence[tuple[Any, ...]]:
    return [(np.sort(draws.integers(0, count, 3 * count)), count) for count in (2, 6, 15)] + [
        (np.zeros(0, int), 4)
    ]


def _starts(tiles: np.ndarray, count: int) -> Answer:
    return np.searchsorted(tiles, np.arange(count + 1))


PARTS = (
    Part(
        "tile_range",
        3,
        _range_cases,
        _tile_range,
        {
            "the ends are the tiles behind the last ones": _last_included,
            "tiles outside the image do not exist": _unclipped,
            "columns come first, then rows": _swapped,
        },
    ),
    Part(
        "pairs",
        4,
        _pair_cases,
        _pairs,
        {
            "sort by the tile first, then by the splat": _by_splat,
            "tiles are numbered row by row: row * columns + column": _by_columns,
        },
    ),
    Part(
        "starts",
        3,
        _start_cases,
        _starts,
        {
            "the end of the last list is missing": lambda tiles, count: _starts(tiles, count)[:-1],
            "these are the ends of the lists; a list begins where the one before it ends": lambda tiles, count: (
                _starts(tiles, count)[1:]
            ),
            "these are the lengths of the lists; add them up": lambda tiles, count: np.diff(
                _starts(tiles, count)
            ),
        },
    ),
)
"""The functions of the assignment: `tile_range`, `pairs` and `starts`."""

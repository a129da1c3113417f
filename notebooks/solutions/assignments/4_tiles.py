"""Assignment 4, tiles: which splats a tile has to look at. For chapter 11; 10 points.

Write the functions, then run: gsplat-edu grade notebooks/assignments/4_tiles.py
"""

import math

import numpy as np

ASSIGNMENT = "tiles"


def tile_range(u, v, radius, width, height, tile):
    """Return the tiles of a splat: first column, first row, the column and the row behind the last.

    The splat reaches the pixels (x, y) with |x - u| and |y - v| up to radius, where x and y are whole numbers, from 0
    to width - 1 and height - 1. A tile has tile by tile pixels. A splat without pixels in the image has (0, 0, 0, 0).
    """
    left, top = max(math.ceil(u - radius), 0), max(math.ceil(v - radius), 0)
    right, bottom = min(math.floor(u + radius), width - 1), min(math.floor(v + radius), height - 1)
    if left > right or top > bottom:
        return 0, 0, 0, 0
    return left // tile, top // tile, right // tile + 1, bottom // tile + 1


def pairs(ranges, columns):
    """Return the pairs (P, 2) of a tile's number and a splat's, by tile, and for each tile by splat.

    ranges (N, 4) has the tiles of each splat as `tile_range` gives them; the image has so many columns of tiles, and
    tiles are numbered row by row.
    """
    found = []
    for splat, (x0, y0, x1, y1) in enumerate(ranges):
        for row in range(y0, y1):
            found += [(row * columns + column, splat) for column in range(x0, x1)]
    return np.array(sorted(found))


def starts(tiles, count):
    """Return where the lists of count tiles begin, and behind them where the last one ends: (count + 1,).

    tiles (P,) are the tiles' numbers of all pairs, sorted.
    """
    lengths = np.bincount(tiles, minlength=count)
    return np.concatenate([[0], np.cumsum(lengths)])

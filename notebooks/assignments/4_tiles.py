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
    raise NotImplementedError("write tile_range")


def pairs(ranges, columns):
    """Return the pairs (P, 2) of a tile's number and a splat's, by tile, and for each tile by splat.

    ranges (N, 4) has the tiles of each splat as `tile_range` gives them; the image has so many columns of tiles, and
    tiles are numbered row by row.
    """
    raise NotImplementedError("write pairs")


def starts(tiles, count):
    """Return where the lists of count tiles begin, and behind them where the last one ends: (count + 1,).

    tiles (P,) are the tiles' numbers of all pairs, sorted.
    """
    raise NotImplementedError("write starts")

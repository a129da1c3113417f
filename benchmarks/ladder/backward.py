"""The backward rungs: what a loss on the image says about every splat, with shared sums and with slots.

    cg = g . c;   w = T alpha;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   T -= w        near to far

`atomics` adds each pair's sums to those of its splat as they come; `slots` writes them down and adds them up in a fixed
order. Both replay the rung `tight`, tile by tile.
"""

from __future__ import annotations

import ctypes
import time
from typing import NamedTuple

import numpy as np

from gsplat_edu.constants import TILE
from ladder.build import library
from ladder.splats import Splats

FLOATS, INTS = ctypes.POINTER(ctypes.c_float), ctypes.POINTER(ctypes.c_int32)


class Gradients(NamedTuple):
    """dL/d each of the arrays of `Splats`, float32."""

    means2d: np.ndarray  # (N, 2)
    conics: np.ndarray  # (N, 3)
    colors: np.ndarray  # (N, 3)
    opacities: np.ndarray  # (N,)

    def bits(self) -> bytes:
        """Return all of it as bytes, to compare to the bit."""
        return b"".join(array.tobytes() for array in self)


class _Splats(ctypes.Structure):
    _fields_ = (
        *((name, FLOATS) for name in ("means2d", "conics", "colors", "opacities")),
        ("count", ctypes.c_int64),
        ("H", ctypes.c_int32),
        ("W", ctypes.c_int32),
    )


class _Job(ctypes.Structure):
    _fields_ = (("image", FLOATS), ("grad_image", FLOATS), ("order", INTS), ("threads", ctypes.c_int32))


class _Gradient(ctypes.Structure):
    _fields_ = (
        *((name, FLOATS) for name in ("means2d", "conics", "colors", "opacities")),
        ("pairs", ctypes.c_int64),
    )


def num_tiles(splats: Splats) -> int:
    """Return how many tiles the screen has."""
    return -(-splats.H // TILE) * -(-splats.W // TILE)


def atomics(
    splats: Splats,
    image: np.ndarray,
    grad_image: np.ndarray,
    threads: int = 1,
    order: np.ndarray | None = None,
) -> Gradients:
    """Go back with sums that all tiles of a splat add to: the result depends on the order of arrival.

    Args:
        splats: What was drawn.
        image: (H, W, 3) what `ladder.forward.tight` drew of them, on black.
        grad_image: (H, W, 3) dL/dimage.
        threads: How many take tiles.
        order: The tiles in the order in which they are handed out; row by row where None.
    """
    return _go_back("backward_atomics", splats, image, grad_image, threads, order)


def slots(
    splats: Splats,
    image: np.ndarray,
    grad_image: np.ndarray,
    threads: int = 1,
    order: np.ndarray | None = None,
) -> Gradients:
    """Go back with a slot for each pair of tile and splat: the same to the bit on any number of threads, in any order.

    Arguments are those of `atomics`.
    """
    return _go_back("backward_slots", splats, image, grad_image, threads, order)


def seconds(rung: str, splats: Splats, image: np.ndarray, grad_image: np.ndarray, threads: int = 1) -> float:
    """Time a rung, lists included: the best of five.

    Args:
        rung: "atomics" or "slots".
        splats: As for the rung, like what follows.
        image: As there.
        grad_image: As there.
        threads: As there.
    """
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        RUNGS[rung](splats, image, grad_image, threads)
        times.append(time.perf_counter() - begin)
    return min(times)


RUNGS = {"atomics": atomics, "slots": slots}


def _go_back(
    function: str,
    splats: Splats,
    image: np.ndarray,
    grad_image: np.ndarray,
    threads: int,
    order: np.ndarray | None,
) -> Gradients:
    tiles = np.arange(num_tiles(splats)) if order is None else order
    inputs = [np.ascontiguousarray(a, np.float32) for a in (image, grad_image)]
    if any(a.shape != (splats.H, splats.W, 3) for a in inputs):
        raise ValueError(f"image, grad_image: have to be ({splats.H}, {splats.W}, 3)")
    if sorted(tiles) != list(range(num_tiles(splats))):
        raise ValueError("order: has to name every tile once")
    tiles = np.ascontiguousarray(tiles, np.int32)
    gradients = Gradients(*(np.empty_like(array) for array in splats[:4]))
    given = _Splats(*(a.ctypes.data_as(FLOATS) for a in splats[:4]), splats.count, splats.H, splats.W)
    job = _Job(*(a.ctypes.data_as(FLOATS) for a in inputs), tiles.ctypes.data_as(INTS), threads)
    out = _Gradient(*(a.ctypes.data_as(FLOATS) for a in gradients))
    getattr(library("backward"), function)(ctypes.byref(given), ctypes.byref(job), ctypes.byref(out))
    return gradients

"""The backward rungs: gradients of a loss on the image for every splat, with shared sums and with slots.

    cg = g . c;   w = T alpha;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   T -= w        near to far

`atomics` adds each pair's sums to those of its splat in order of arrival; `slots` stores them and adds them up in a
fixed order. Both replay the rung `tight`, tile by tile.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np

from gsplat_edu.base.constants import TILE
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
        """Return all gradients as bytes, for bit-exact comparison."""
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
    """Return the number of tiles of the screen."""
    return -(-splats.H // TILE) * -(-splats.W // TILE)


def atomics(
    splats: Splats,
    image: np.ndarray,
    grad_image: np.ndarray,
    threads: int = 1,
    order: np.ndarray | None = None,
) -> Gradients:
    """Run the backward pass with sums shared by all tiles of a splat: the result depends on the order of arrival.

    Args:
        splats: The splats that were drawn.
        image: (H, W, 3) their image by `ladder.forward.tight`, on black.
        grad_image: (H, W, 3) dL/dimage.
        threads: Number of threads.
        order: The tiles in the order in which they are handed out; row by row if None.
    """
    return _run_backward("backward_atomics", splats, image, grad_image, threads, order)


def slots(
    splats: Splats,
    image: np.ndarray,
    grad_image: np.ndarray,
    threads: int = 1,
    order: np.ndarray | None = None,
) -> Gradients:
    """Run the backward pass with a slot for each pair of tile and splat: bit-identical for any threads and order.

    Arguments are those of `atomics`.
    """
    return _run_backward("backward_slots", splats, image, grad_image, threads, order)


RUNGS = {"atomics": atomics, "slots": slots}


def _run_backward(
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

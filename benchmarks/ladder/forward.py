"""The rungs of the forward pass behind one interface: splats in; image, transmittance and counts out.

alpha = min(0.99, o exp(-d' conic d / 2)), 0 below 1/255;   image += T alpha c;   T *= 1 - alpha
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from gsplat_edu.render.cpu.render import render_covariances
from ladder.build import library
from ladder.splats import Splats

FLOATS = ctypes.POINTER(ctypes.c_float)
SPLAT_BYTES, COLOR_BYTES, PIXEL_BYTES = 24, 12, 16
"""Bytes that a kernel accesses: mean, conic and opacity; a colour; a pixel's colour and transmittance. All float32."""


class Counts(NamedTuple):
    """The work of a rung for one image."""

    pairs: int  # entries in the tiles' lists; 0 if there are no tiles
    evaluated: int  # evaluations of a splat's alpha at a pixel
    mattered: int  # those with an alpha not below the floor
    bytes: int  # loaded and stored while compositing, from any cache


class Rendered(NamedTuple):
    """The result of a rung."""

    image: np.ndarray  # (H, W, 3), on a black background
    transmittance: np.ndarray  # (H, W)
    counts: Counts


class _Splats(ctypes.Structure):
    _fields_ = (
        *((name, FLOATS) for name in ("means2d", "conics", "colors", "opacities")),
        ("count", ctypes.c_int64),
        ("H", ctypes.c_int32),
        ("W", ctypes.c_int32),
    )


class _Drawn(ctypes.Structure):
    _fields_ = (
        ("image", FLOATS),
        ("transmittance", FLOATS),
        *((name, ctypes.c_int64) for name in ("pairs", "evaluated", "mattered")),
    )


def _draw(rung: str, splats: Splats) -> Rendered:
    """Call the function of a rung's library; it has the rung's name."""
    image = np.empty((splats.H, splats.W, 3), np.float32)
    transmittance = np.empty((splats.H, splats.W), np.float32)
    given = _Splats(*(a.ctypes.data_as(FLOATS) for a in splats[:4]), splats.count, splats.H, splats.W)
    drawn = _Drawn(*(a.ctypes.data_as(FLOATS) for a in (image, transmittance)))
    getattr(library(rung), rung)(ctypes.byref(given), ctypes.byref(drawn))
    loads = SPLAT_BYTES * drawn.evaluated + COLOR_BYTES * drawn.mattered
    if (
        rung != "naive"
    ):  # a record is read once for all pixels of a tile, and the pixels are in the nearest cache
        loads = (SPLAT_BYTES + COLOR_BYTES) * drawn.pairs
    counts = Counts(drawn.pairs, drawn.evaluated, drawn.mattered, loads + PIXEL_BYTES * splats.pixels)
    return Rendered(image, transmittance, counts)


def naive(splats: Splats) -> Rendered:
    """Every pixel reads every splat; nothing stops. Equals the oracle with exact extents and no stop."""
    return _draw("naive", splats)


def tiled(splats: Splats) -> Rendered:
    """Tiles with lists by the 3-sigma box, and a stop. Equals the oracle with these boxes and the tile's stop."""
    return _draw("tiled", splats)


def tight(splats: Splats) -> Rendered:
    """Tiles with lists by the exact ellipse. Equals the oracle with exact extents and the tile's stop."""
    return _draw("tight", splats)


def simd(splats: Splats) -> Rendered:
    """As `tight`, a row of sixteen pixels at a time."""
    return _draw("simd", splats)


def package(splats: Splats) -> Rendered:
    """The package's own kernels on one thread, including projection and sort."""
    return _prepared_package(splats)()


RUNGS: dict[str, Callable[[Splats], Rendered]] = {
    "naive": naive,
    "tiled": tiled,
    "tight": tight,
    "simd": simd,
    "package": package,
}


def _prepared_package(splats: Splats) -> Callable[[], Rendered]:
    camera, *arrays = splats.flat()
    tensors = [torch.tensor(array, dtype=torch.float32) for array in arrays]

    def render() -> Rendered:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            with torch.no_grad():
                output = render_covariances(*tensors, camera)
        finally:
            torch.set_num_threads(threads)
        counts = Counts(output.num_pairs, 0, 0, 0)  # the package counts only its pairs
        return Rendered(output.image.numpy(), output.transmittance.numpy(), counts)

    return render


def seconds(rung: str, splats: Splats, enough: float = 0.2, rounds: int = 5) -> tuple[float, Rendered]:
    """Time a rung on one thread: the best of several rounds, after a warm-up round.

    The clock is the process's CPU time, which other programs on the same cores do not lengthen.

    Args:
        rung: Its name in RUNGS.
        splats: The splats to draw. Converting them for the package and compiling are not timed.
        enough: Seconds after which no further round starts.
        rounds: Maximum number of rounds.
    """
    if rung != "package":
        library(rung)
    draw = _prepared_package(splats) if rung == "package" else lambda: RUNGS[rung](splats)
    times: list[float] = []
    while not times or (len(times) <= rounds and sum(times) < enough):
        start = time.process_time()
        rendered = draw()
        times.append(time.process_time() - start)
    return min(times[1:] or times), rendered

"""Statistics of each Gaussian, from the buffers of a frame whose gradients have just been taken.

weigh -> collect -> sum_statistics
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsplat_edu.engine.host import Memory
from gsplat_edu.engine.passes import Buffer, Pass, Program, Size

COLLECTED, WEIGHED = 6, 6
"""Numbers of a Gaussian and of a pixel, in the order of `statistics.wgsl`."""


@dataclass(frozen=True, eq=False)
class Asked:
    """A request for statistics.

    Args:
        view: The uniform block of the frame, `View.packed`.
        errors: (H, W) float32 error of each pixel; None for zero.
    """

    view: bytes
    errors: np.ndarray | None = None


@functools.cache
def _program(buffers: tuple[Buffer, ...], records: str, image: str, seam: str) -> Program:
    """Return the program that reads these buffers of a frame; `seam` is "_seam" for a panorama's."""
    own = (
        *(Buffer("errors", Size("pixels")), Buffer("weighed", Size("pixels", WEIGHED))),
        *(
            Buffer("statistic_slots", Size("pairs", COLLECTED)),
            Buffer("collected", Size("gaussians", COLLECTED)),
        ),
    )
    lists = (records, "owner", "slot_of", "tiles", "done", "weighed")
    sums = ("spans", "statistic_slots")
    passes = (
        Pass("statistics", "weigh", (image, "grads", "errors"), ("weighed",), Size("pixels"), 256),
        Pass(f"statistics{seam}", "collect", lists, ("statistic_slots",), Size("edges"), 1),
        Pass("statistics", "sum_statistics", sums, ("collected",), Size("gaussians"), 64),
    )
    used = {name for one in passes for name in (*one.reads, *one.writes)}
    return Program((*(one for one in buffers if one.name in used), *own), {"statistics": passes})


def statistics_program(frame: Program, of_features: bool) -> Program:
    """Return the program that collects statistics of a frame.

    Args:
        frame: The frame's program, whose buffers it reads.
        of_features: Whether of the features that were composited last, instead of the colours.
    """
    wraps = any(one.module == "composite_seam" for one in frame.passes())
    drawn = ("painted", "feature_image") if of_features else ("records", "image")
    return _program(frame.buffers, *drawn, "_seam" if wraps else "")


def collect(memory: Memory, asked: Asked, of_features: bool = False) -> np.ndarray:
    """Collect statistics after composite_backward.

    Args:
        memory: The frame's buffers.
        asked: The request.
        of_features: Whether the features were composited last, instead of the colours.

    Returns:
        (N, 6) float32, in the order of `gsplat_edu.render.output.STATISTICS`.

    Raises:
        BackendUnavailableError: the device fails, or has no buffers that large.
    """
    counts: Mapping[str, int] = memory.counts
    own = memory.device.allocate(statistics_program(memory.program, of_features), counts, like=memory)
    errors = np.zeros(counts["pixels"], dtype=np.float32) if asked.errors is None else asked.errors
    own.write("errors", errors)
    found = own.play("statistics", asked.view, read=("collected",))["collected"]
    return found.view(np.float32)[: counts["gaussians"] * COLLECTED].reshape(-1, COLLECTED).copy()

"""Runs of indices: the splats of a selection by `list`, as [start, count, start, count, ...]."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from gsplat_edu.base.errors import ArgumentError

MOST_NUMBERS = 4_000_000
"""Numbers of a list, two for each run."""

MOST_SPLATS = 2**31 - 1
"""Largest index and count."""


def check_runs(runs: tuple[int, ...]) -> None:
    """Check runs: each has at least one splat, and a gap before the next one.

    Raises:
        ArgumentError: they are wrong; the message names the place.
    """
    if len(runs) % 2:
        raise ArgumentError(
            f"runs: has {len(runs)} numbers, but has to have a start and a count for each run"
        )
    end = -1
    for i, (start, count) in enumerate(zip(runs[::2], runs[1::2], strict=True)):
        if count < 1:
            raise ArgumentError(f"runs[{2 * i + 1}]: is {count}, but has to be at least 1")
        if start <= end:
            raise ArgumentError(f"runs[{2 * i}]: is {start}, but the run before ends at {end}; leave a gap")
        end = start + count


def end_of(runs: tuple[int, ...]) -> int:
    """Return the index after the last splat of checked runs; 0 if there is none."""
    return runs[-2] + runs[-1] if runs else 0


def runs_of(mask: Bool[np.ndarray, " N"]) -> list[int]:
    """Return the runs of N splats that a mask holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]
    runs: list[int] = np.stack([starts, ends - starts], axis=1).ravel().tolist()
    return runs


def mask_of(runs: tuple[int, ...], count: int) -> Bool[np.ndarray, " N"]:
    """Return which of `count` splats the runs hold.

    Args:
        runs: Checked runs.
        count: Number of splats, N; runs beyond it hold none.
    """
    edges = np.array(runs, dtype=np.int64).reshape(-1, 2)
    steps = np.zeros(count + 1, dtype=np.int8)
    begins, ends = np.minimum(edges[:, 0], count), np.minimum(edges.sum(axis=1), count)
    np.add.at(steps, begins, 1)
    np.add.at(steps, ends, -1)
    mask: Bool[np.ndarray, " N"] = np.cumsum(steps[:count], dtype=np.int8) > 0
    return mask

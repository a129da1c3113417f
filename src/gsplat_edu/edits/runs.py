"""Runs of indices: the splats of a selection by `list`, as [start, count, start, count, ...]."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.json_fields import as_json, checked_list

MOST_NUMBERS = 4_000_000
"""Numbers of a list, two for each run."""

MOST_SPLATS = 2**31 - 1
"""Largest index and count."""


def parsed_runs(where: str, value: object) -> tuple[int, ...]:
    """Return checked runs: whole numbers, each run with at least one splat, and a gap before the next one.

    Args:
        where: The place in the file, for messages.
        value: The runs, as JSON.

    Raises:
        ArgumentError: they are wrong; the message names the place.
    """
    numbers = checked_list(where, value, MOST_NUMBERS)
    if len(numbers) % 2:
        raise ArgumentError(
            f"{where}: has {len(numbers)} numbers, but has to have a start and a count for each run"
        )
    for i, number in enumerate(numbers):
        if type(number) is not int or not i % 2 <= number <= MOST_SPLATS:
            wanted = "a whole number from " + ("1" if i % 2 else "0") + f" to {MOST_SPLATS:,}"
            raise ArgumentError(f"{where}[{i}]: is {as_json(number)}, but has to be {wanted}")
    starts, ends = (
        numbers[::2],
        [start + count for start, count in zip(numbers[::2], numbers[1::2], strict=True)],
    )
    for i, (end, start) in enumerate(zip(ends, starts[1:], strict=False)):
        if start <= end:
            raise ArgumentError(
                f"{where}[{2 * i + 2}]: is {start}, but the run before ends at {end}; leave a gap"
            )
    return tuple(numbers)


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

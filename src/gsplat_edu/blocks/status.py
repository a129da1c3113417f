"""The state of every block, read from its files, which does not slow the trainings and works wherever they run."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.base.reading import open_file, parse_json
from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.runs.blocks_folder import BlocksFolder

TAIL = 4096
"""Number of bytes at the end of a log that are searched for its last whole line."""


@dataclass(frozen=True)
class BlockStatus:
    """What is known of a block.

    Args:
        number: The block.
        views: Number of its training views.
        iteration: Steps taken.
        iterations: Steps of the whole training.
        loss: Mean loss of the last steps; None before the first.
        gaussians: Number of Gaussians; None before the first step.
        done: Whether it is finished.
    """

    number: int
    views: int
    iteration: int
    iterations: int
    loss: float | None
    gaussians: int | None
    done: bool


def statuses(folder: BlocksFolder, plan: BlockPlan, digest: str) -> list[BlockStatus]:
    """Return the state of every block.

    Args:
        folder: The run in blocks.
        plan: Its plan.
        digest: Digest of the plan.
    """
    found = []
    for number, block in enumerate(plan.blocks):
        wanted = block.iterations or int(plan.recipe["train"]["iterations"])
        views = len(block.train)
        if (done := folder.read_done(number, digest)) is not None:
            found.append(BlockStatus(number, views, done.iterations, wanted, None, done.gaussians, True))
        else:
            found.append(BlockStatus(number, views, *_last(folder, number, wanted), False))
    return found


def _last(folder: BlocksFolder, number: int, wanted: int) -> tuple[int, int, float | None, int | None]:
    """Return iteration, iterations, loss and number of Gaussians by the last line of a block's log that has them."""
    try:
        with open_file(folder.run(number).log_file) as file:
            file.seek(max(file.seek(0, 2) - TAIL, 0))
            lines = file.read().split(b"\n")
    except OSError:
        return 0, wanted, None, None
    for line in reversed(lines[:-1]):
        try:
            entry = parse_json(line.decode())
            return int(entry["iteration"]), wanted, float(entry["loss"]), int(entry["num_gaussians"])
        except (ValueError, KeyError, TypeError, OverflowError):
            continue  # cut off, or of another kind
    return 0, wanted, None, None

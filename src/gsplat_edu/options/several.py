"""Checks of the options of `gsplat-edu train` on several processes."""

from __future__ import annotations

import argparse

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.jobs.ranks import num_processes, restarts_are_allowed


def check_several(arguments: argparse.Namespace) -> None:
    """Check what only holds for several processes; nothing for one.

    Raises:
        ArgumentError: an option does not go with them.
    """
    size, batch = num_processes(), arguments.batch or 1
    if size == 1:
        return
    if batch % size:
        raise ArgumentError(
            f"--batch: is {batch}, but has to be a multiple of the {size} processes, so that each renders equally many"
            " views"
        )
    if arguments.view:
        raise ArgumentError(
            "--view: shows the training of one process; leave it out, or train without torchrun"
        )
    if arguments.time_limit is not None and arguments.iterations is None:
        raise ArgumentError(
            "--time-limit: cannot choose the length for several processes; give --iterations too"
        )
    if restarts_are_allowed() and not arguments.resume:
        raise ArgumentError("--resume: is needed with --max-restarts, so that a restart continues; add it")

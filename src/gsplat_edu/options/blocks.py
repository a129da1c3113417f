"""Options of runs in blocks, of `train` and of the commands that train and merge blocks."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, CheckpointError, DatasetError
from gsplat_edu.base.text import option_flag
from gsplat_edu.base.validation import whole_number
from gsplat_edu.options.values import whole_number_text
from gsplat_edu.runs.blocks_folder import MOST_BLOCKS, PLAN
from gsplat_edu.train.config import WITH_OPTION
from gsplat_edu.train.part import questions

LEAST_VIEWS = 50
"""Default of --min-views."""

COARSE_SHARE = 0.5
"""Default length of the coarse training, in lengths of a block's."""

COARSE_FACTOR = 2.0
"""The coarse training sees photos whose sides are divided by this, in addition to --resolution."""

SPLIT, MERGE = UNTIL = ("split", "merge")
"""Steps of a run in blocks after which --until ends it."""

UNUSED = {
    "points": "the coarse model starts from the capture's points",
    "time_limit": "give --iterations or --quality",
    "max_memory": "use more blocks, or --resolution",
    "view": "watch the table",
    **{name: option.instead_in_blocks for name, option in WITH_OPTION.items() if option.instead_in_blocks},
    **{each.name: each.instead_in_blocks for each in questions().values() if each.instead_in_blocks},
}
"""Options of train that do not go with --blocks, and what to do instead."""


def add_blocks(parser: argparse.ArgumentParser) -> None:
    """Add the options that split a capture."""
    group = parser.add_argument_group(
        "blocks",
        "For captures too large for one machine or its memory; docs/SCALE.md explains them. --iterations and --quality"
        " are those of each block, --max-gaussians is that of the whole scene; --from is the coarse model.",
    )
    group.add_argument(
        "--blocks",
        metavar="N|auto",
        help="split the ground into this many blocks, train each as a run of its own, and merge them; auto makes one"
        " for every 200 training views (default: train the capture as a whole)",
    )
    group.add_argument(
        "--until",
        choices=UNTIL,
        help="end after this step: split trains the coarse model and makes the blocks, which `gsplat-edu block` trains"
        " on any machine and `gsplat-edu merge` merges (default: merge)",
    )
    for flag, text in (
        ("--min-views", f"blocks with fewer training views join a neighbour (default: {LEAST_VIEWS})"),
        ("--coarse-iterations", "steps of the coarse model of the whole (default: half of those of a block)"),
    ):
        group.add_argument(flag, type=whole_number_text, metavar="N", help=text)


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where blocks are trained."""
    group = parser.add_argument_group("cluster (extra cluster)")
    group.add_argument(
        "--workers",
        type=whole_number_text,
        metavar="N",
        help="train this many blocks at a time, in processes of this computer (default: one, in this process)",
    )
    group.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="train the blocks on the workers of this dask.distributed scheduler, which see RUN and DATA under the same"
        " paths. Whoever reaches a scheduler can run programs on its workers: use tls:// or a network that you trust",
    )


def add_run(parser: argparse.ArgumentParser) -> None:
    """Add the folder of a run in blocks, and where its capture is."""
    parser.add_argument(
        "run_folder", type=Path, metavar="RUN", help="folder that `gsplat-edu train --blocks` made"
    )
    parser.add_argument(
        "--data",
        type=Path,
        metavar="PATH",
        help="the capture on this computer (default: the path it was split at)",
    )


def check_run(arguments: argparse.Namespace) -> None:
    """Check the options of `add_run`.

    Raises:
        CheckpointError: the folder has no plan.
        DatasetError: there is nothing under --data.
    """
    folder = arguments.run_folder
    if not (folder / PLAN).is_file():
        raise CheckpointError(
            f"{folder}: has no {PLAN}; `train CAPTURE --out {folder} --blocks auto --until split` makes it"
        )
    if arguments.data is not None and not arguments.data.exists():
        raise DatasetError(f"--data: {arguments.data} does not exist; give the folder of the capture")


def block_count(arguments: argparse.Namespace) -> int | None:
    """Return the number of blocks; None for auto.

    Raises:
        ArgumentError: --blocks is neither auto nor a number in range.
    """
    if arguments.blocks == "auto":
        return None
    try:
        count = int(arguments.blocks)
    except ValueError:
        count = 0
    if not 1 <= count <= MOST_BLOCKS:
        raise ArgumentError(
            f"--blocks: is {arguments.blocks}, but has to be auto or a number from 1 to {MOST_BLOCKS}"
        )
    return count


def check_blocks(arguments: argparse.Namespace) -> None:
    """Check the options of blocks.

    Raises:
        ArgumentError: one is out of range, or does not go with the others.
    """
    if arguments.blocks is None:
        for name in ("min_views", "coarse_iterations", "until", "workers", "scheduler"):
            if getattr(arguments, name, None) is not None:
                flag = option_flag(name)
                raise ArgumentError(f"{flag}: has an effect only with --blocks; add --blocks, or omit {flag}")
        return
    block_count(arguments)
    if arguments.until == SPLIT:
        for name, advice in (
            ("export", "give it to `gsplat-edu merge`"),
            ("workers", "blocks are not trained"),
            ("scheduler", "blocks are not trained"),
        ):
            if getattr(arguments, name):
                raise ArgumentError(f"--{name}: does not go with --until split; {advice}")
    for name, advice in UNUSED.items():
        if getattr(arguments, name) not in (None, False, "none"):
            raise ArgumentError(f"{option_flag(name)}: does not go with --blocks; {advice}")
    for name in ("min_views", "coarse_iterations", "workers"):
        if getattr(arguments, name, None) is not None:
            whole_number(option_flag(name), getattr(arguments, name), 1)
    if arguments.coarse_iterations is not None and arguments.scene is not None:
        raise ArgumentError("--coarse-iterations: --from gives the coarse model already; omit one of them")
    if getattr(arguments, "workers", None) is not None and arguments.scheduler is not None:
        raise ArgumentError("--workers: --scheduler has workers of its own; omit one of them")

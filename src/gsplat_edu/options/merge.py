"""The options of `gsplat-edu merge`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.options.blocks import add_run, check_run

EXAMPLE = "example: gsplat-edu merge runs/town --export town.spz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_run(parser)
    parser.add_argument(
        "--export",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="also write the scene in other formats, as `gsplat-edu convert --verify` does",
    )


def check(arguments: argparse.Namespace) -> None:
    """Check the options.

    Raises:
        CheckpointError: the folder has no plan.
        DatasetError: there is nothing under --data.
    """
    check_run(arguments)

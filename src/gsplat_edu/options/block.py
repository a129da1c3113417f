"""The options of `gsplat-edu block`."""

from __future__ import annotations

import argparse

from gsplat_edu.base.validation import whole_number
from gsplat_edu.options.blocks import add_run, check_run
from gsplat_edu.options.values import whole_number_text

EXAMPLE = "example: gsplat-edu block runs/town 3"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_run(parser)
    parser.add_argument("number", type=whole_number_text, metavar="K", help="the block, from 0")


def check(arguments: argparse.Namespace) -> None:
    """Check the options.

    Raises:
        ArgumentError: the number is negative.
        CheckpointError: the folder has no plan.
        DatasetError: there is nothing under --data.
    """
    whole_number("K", arguments.number, 0)
    check_run(arguments)

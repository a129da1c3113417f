"""The options of `gsplat-edu grade`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError

EXAMPLE = "example: gsplat-edu grade notebooks/assignments/1_projection.py"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    meant = "Python file with the answers; it is executed, and may do what you may do"
    parser.add_argument("file", type=Path, metavar="FILE", help=meant)
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="chooses the cases, so that a class does not know them (default: 0)",
    )


def check(arguments: argparse.Namespace) -> None:
    """Check that there is a file, and the seed.

    Raises:
        ArgumentError: there is no file, or the seed is negative.
    """
    if not arguments.file.is_file():
        raise ArgumentError(f"{arguments.file}: is no file; give the Python file with your answers")
    if arguments.seed < 0:
        raise ArgumentError(f"--seed: {arguments.seed} is negative; give a whole number from 0 on")

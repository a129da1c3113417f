"""The options of `gsplat-edu info`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.options.poses import add_poses, add_trust, posed_by

EXAMPLE = "example: gsplat-edu info captures/plush"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    meant = "capture, run folder, scene or mesh file; without it, describe this computer and its GPUs"
    parser.add_argument("path", type=Path, metavar="PATH", nargs="?", help=meant)
    add_poses(parser)
    add_trust(parser)


def check(arguments: argparse.Namespace) -> None:
    """Let the file with poses stand for its capture.

    Raises:
        ArgumentError: it is no file with poses, or not of this capture.
    """
    arguments.path = posed_by(arguments.path, arguments.poses)

"""The option `--depth`: depth that the user has."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.scene.given_depth import CAPTURE_AS_DEPTH, POINTS_AS_DEPTH

WORDS = (POINTS_AS_DEPTH, CAPTURE_AS_DEPTH)
"""Values that are no folders."""


def add_depth(group: argparse._ActionsContainer, text: str) -> None:
    """Add the option.

    Args:
        group: Receives it.
        text: What the command does with the depth.
    """
    group.add_argument(
        "--depth",
        type=Path,
        metavar="DIR",
        help=f"{text}: of a folder with a map for each photo (16-bit PNG, TIFF, NPY, NPZ, EXR, COLMAP's geometric maps,"
        " Record3D); capture: the maps that transforms.json or COLMAP's folder has; points: the points of COLMAP's"
        " tracks",
    )


def check_depth(path: Path | None) -> None:
    """Check the option without reading a map.

    Args:
        path: Its value; None if it is not given.

    Raises:
        ArgumentError: the folder does not exist.
    """
    if path is not None and str(path) not in WORDS and not path.is_dir():
        raise ArgumentError(
            f"--depth: {path} is no folder; give the folder of maps, or one of the words {' and '.join(WORDS)}"
        )

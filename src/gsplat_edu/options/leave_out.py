"""The options of `gsplat-edu leave-out`."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLE = "example: gsplat-edu leave-out captures/plush images/0030.jpg"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "capture", type=Path, metavar="CAPTURE", help="capture, whose left_out.txt is changed"
    )
    meant = "paths of photos below the capture, their names in it, or file names; without any, list what is left out"
    parser.add_argument("photos", metavar="PHOTO", nargs="*", help=meant)
    parser.add_argument(
        "--undo", action="store_true", help="use the photos again; without PHOTO, all of them"
    )

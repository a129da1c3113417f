"""The options of `gsplat-edu mask`."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLE = "example: gsplat-edu mask captures/plush images/0030.jpg 0,0,400,250 900,10,1100,300,820,340"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "capture", type=Path, metavar="CAPTURE", help="capture, whose mask of the photo is changed"
    )
    meant = "path of a photo below the capture, its name in it, or its file name"
    parser.add_argument("photo", metavar="PHOTO", help=meant)
    shapes = (
        "X0,Y0,X1,Y1: a rectangle, in pixels of the upright photo; three and more corners: a polygon; "
        "brush:RADIUS,X,Y,X,Y and more points: a brush stroke. They replace the shapes drawn before, and add to the "
        "photo's own mask; without any, list what is drawn"
    )
    parser.add_argument("shapes", metavar="SHAPE", nargs="*", help=shapes)
    parser.add_argument(
        "--undo",
        action="store_true",
        help="take all shapes back; the photo's mask is then as it was, to the byte",
    )

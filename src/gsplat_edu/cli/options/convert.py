"""The options of `gsplat-edu convert`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.cli.arguments import add_backend, numbers_text, whole_number_text
from gsplat_edu.constants import SH_MAX_DEGREE

EXAMPLE = "example: gsplat-edu convert runs/plush plush.spz --min-opacity 0.02 --verify"

MOVES = "scale=S, rotate=AXIS:DEGREES (x:90), move=X,Y,Z or matrix=FILE (12 or 16 numbers, rows first)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("sources", type=Path, nargs="+", metavar="IN", help="scene file, or folder of a run")
    parser.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        help="file to write: its suffix is the format, .ply .compressed.ply .splat .spz .sog .glb or .html"
        " (a page that draws the scene); FOLDER/meta.json is a SOG in a folder",
    )
    parser.add_argument("--merge", action="store_true", help="join several IN into one scene")
    parser.add_argument(
        "--sh-degree",
        type=whole_number_text,
        default=SH_MAX_DEGREE,
        metavar="N",
        help="highest degree of harmonics to keep (default: %(default)s)",
    )
    parser.add_argument(
        "--min-opacity", type=float, default=0.0, metavar="A", help="leave out splats of lower opacity"
    )
    parser.add_argument(
        "--crop",
        type=numbers_text(6),
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="keep splats whose centre lies in the box, in the coordinates of IN; --crop=-1,... where it"
        " begins with a minus",
    )
    parser.add_argument(
        "--transform",
        action="append",
        default=[],
        metavar="KIND=VALUE",
        help=f"move the scene, after --crop; {MOVES}; several are done in their order",
    )
    parser.add_argument(
        "--verify",
        action="store_true",
        help="read OUT again and compare renders of both, from some of the run's cameras or an orbit",
    )
    add_backend(parser)

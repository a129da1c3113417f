"""The options of `gsplat-edu view`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.options.values import add_address, add_meshes, whole_number_text
from gsplat_edu.server.address import PORT

EXAMPLE = "example: gsplat-edu view runs/plush"

BESIDE = Path()
"""Value of --edit without a file."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "source",
        type=Path,
        metavar="SCENE|RUN|CAPTURE",
        help="scene file, run folder, folder with levels of detail, or capture: its cameras, photos and points",
    )
    add_address(parser, PORT)
    parser.add_argument(
        "--path",
        type=Path,
        metavar="FILE",
        help="keyframes, as for render --path, that the page plays",
    )
    add_meshes(parser)
    parser.add_argument(
        "--budget",
        type=whole_number_text,
        metavar="N",
        help="splats drawn at once of a scene with levels of detail (default: by the machine that shows the page:"
        " 1,000,000 on a phone, 2,000,000 with up to 4 GB of memory, else 4,000,000)",
    )
    parser.add_argument(
        "--edit",
        type=Path,
        nargs="?",
        const=BESIDE,
        metavar="FILE",
        help="open the editor, which reads and saves its operations in FILE (default: NAME.edits.json beside the scene,"
        " edits.json in a run), for convert --edits; the URL has a token",
    )
    parser.add_argument("--no-open", action="store_true", help="print the URL without opening a browser")

"""The options of `gsplat-edu view`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.cli.arguments import whole_number_text
from gsplat_edu.viewer.serve import LOOPBACK

EXAMPLE = "example: gsplat-edu view runs/plush"

PORT = 8080


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("source", type=Path, metavar="SCENE|RUN", help="scene file, or folder of a run")
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        metavar="ADDRESS",
        help=f"where to listen (default: {LOOPBACK}, which only this computer can reach)",
    )
    parser.add_argument(
        "--port",
        type=whole_number_text,
        default=PORT,
        metavar="N",
        help=f"port to listen at, 0 for any that is free (default: {PORT})",
    )
    parser.add_argument("--no-open", action="store_true", help="print the URL, but do not open the browser")

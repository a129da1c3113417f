"""The options of `gsplat-edu web`."""

from __future__ import annotations

import argparse

from gsplat_edu.options.values import add_address

EXAMPLE = "example: gsplat-edu web --port 9000"

PORT = 8070
"""Default port: another one than those of a single page and of the studio."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_address(parser, PORT)
    parser.add_argument("--no-open", action="store_true", help="print the URL without opening a browser")

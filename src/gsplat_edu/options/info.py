"""The options of `gsplat-edu info`."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLE = "example: gsplat-edu info captures/plush"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's argument."""
    meant = "capture, run folder or scene file; without it, describe this computer and its GPUs"
    parser.add_argument("path", type=Path, metavar="PATH", nargs="?", help=meant)

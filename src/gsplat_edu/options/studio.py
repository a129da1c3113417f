"""The options of `gsplat-edu studio`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.validation import whole_number
from gsplat_edu.options.values import add_address, bytes_text, whole_number_text

EXAMPLE = "example: gsplat-edu studio ~/scenes"

PORT = 8090
"""Default port: another one than that of a single page."""

MOST_JOBS = 64
"""Most jobs at the same time."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "folder",
        type=Path,
        nargs="?",
        default=Path("studio"),
        metavar="FOLDER",
        help="library of photos, captures, runs and scenes; created if missing (default: studio)",
    )
    add_address(parser, PORT)
    parser.add_argument(
        "--jobs",
        type=whole_number_text,
        default=1,
        metavar="N",
        help="jobs that run at the same time; each uses all cores (default: 1)",
    )
    parser.add_argument(
        "--max-upload",
        type=bytes_text,
        metavar="SIZE",
        help="largest file that the page may upload (default: 4GiB)",
    )
    parser.add_argument(
        "--max-library",
        type=bytes_text,
        metavar="SIZE",
        help="largest size of FOLDER up to which the page may upload (default: 200GiB)",
    )
    parser.add_argument("--no-open", action="store_true", help="print the URL without opening a browser")


def check(arguments: argparse.Namespace) -> None:
    """Check the ranges.

    Raises:
        ArgumentError: an option is out of range.
    """
    whole_number("--jobs", arguments.jobs, 1, MOST_JOBS)

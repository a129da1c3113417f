"""The options of `gsplat-edu doctor`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.validation import whole_number
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.options.asked import add_about_capture, check_asked
from gsplat_edu.options.poses import add_poses, add_trust, posed_by
from gsplat_edu.options.values import add_backend, number_text, whole_number_text
from gsplat_edu.train.length import DEFAULT_QUALITY

EXAMPLE = "example: gsplat-edu doctor captures/plush"

OFFERED = ("resolution",)
"""Options that requests may give."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument(
        "path", type=Path, metavar="PATH", help="capture (before training) or run folder (after it)"
    )
    before = parser.add_argument_group("before training")
    add_poses(before)
    add_trust(before)
    before.add_argument(
        "--no-forecast", action="store_true", help="skip the forecast of training time and memory"
    )
    before.add_argument(
        "--iterations",
        type=whole_number_text,
        metavar="N",
        help=f"iterations of the forecast training (default: those of --quality {DEFAULT_QUALITY} in train)",
    )
    before.add_argument(
        "--resolution",
        type=number_text,
        metavar="R",
        help="resolution of the forecast training: a divisor below 32, or the longest side in px",
    )
    add_about_capture(before)
    after = parser.add_argument_group("after training")
    after.add_argument(
        "--dataset",
        type=Path,
        metavar="PATH",
        help="the run's capture, if its folder has moved",
    )
    after.add_argument("--all-views", action="store_true", help="list the PSNR of every view, worst first")
    add_backend(parser)


def check(arguments: argparse.Namespace) -> None:
    """Check the numbers, the depth and the file with poses, which then stands for its capture.

    Raises:
        ArgumentError: a number is out of range, the folder of depth does not exist, or a file is no file with poses.
    """
    arguments.path = posed_by(arguments.path, arguments.poses)
    DataSettings(resolution=arguments.resolution)
    if arguments.iterations is not None:
        whole_number("--iterations", arguments.iterations, 1)
    check_asked(arguments)

"""The options of `gsplat-edu render`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.cli.arguments import add_backend, whole_number_text

EXAMPLE = "example: gsplat-edu render out/plush --orbit --frames 120 --out plush.mp4"

SCENE_SIZE = 512
"""px: images of a scene that came without cameras."""

RUNS_CAMERAS = ""
"""What --dataset is without a path."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("source", type=Path, metavar="RUN|SCENE", help="folder of a run, or a scene file")
    parser.add_argument(
        "--dataset",
        nargs="?",
        const=RUNS_CAMERAS,
        metavar="PATH",
        help="render from the run's cameras, or from those of the dataset PATH",
    )
    parser.add_argument(
        "--orbit",
        action="store_true",
        help="render a path that stays where the photos were taken: a full circle if the cameras stand all round,"
        " else only as far as they go (default)",
    )

    def number(flag: str, default: int | None, text: str) -> None:
        parser.add_argument(flag, type=whole_number_text, metavar="N", default=default, help=text)

    number("--frames", 120, "frames of the path (default: 120)")
    number(
        "--size",
        None,
        f"longer side of the images in px (default: the cameras'; {SCENE_SIZE} for a scene file)",
    )
    number("--fps", 30, "frames per second of a video (default: 30)")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR|X.mp4",
        help="folder of PNGs, or a video, VP9 in MP4 (default: renders/ in the run, out/ for a scene file)",
    )
    parser.add_argument(
        "--white-background", action="store_true", help="render over white (default: the run's background)"
    )
    add_backend(parser)

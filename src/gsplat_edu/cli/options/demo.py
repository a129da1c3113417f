"""The options of `gsplat-edu demo`, and of `train/train_3d.py`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

from gsplat_edu.cli.arguments import add_backend, whole_number_text

EXAMPLE = "example: gsplat-edu demo --iters 100 --size 48 --out out/quick.png"


class Budget(NamedTuple):
    """How long to train, up to how many Gaussians, at which image size."""

    iters: int
    cap: int
    size: int


CHAPTER = Budget(iters=800, cap=1600, size=128)
"""The chapter's run."""

REDUCED = Budget(iters=300, cap=800, size=64)
"""What the dense backend torch trains by default: about a twentieth of the chapter's work."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""

    def number(flag: str, default: int, text: str) -> None:
        parser.add_argument(
            flag, type=whole_number_text, metavar="N", default=default, help=f"{text} (default: {default})"
        )

    for name, text in (
        ("iters", "training iterations"),
        ("cap", "largest number of Gaussians"),
        ("size", "height and width of the images in px"),
    ):
        default = f"(default: {getattr(CHAPTER, name)}; {getattr(REDUCED, name)} on the dense backend torch)"
        parser.add_argument(f"--{name}", type=whole_number_text, metavar="N", help=f"{text} {default}")
    number("--k0", 400, "Gaussians at the start")
    number("--seed", 9, "seed of the start, the splits and the view order")
    add_backend(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="X.png",
        default=Path("out/sphere.png"),
        help="figure of the held-out camera; X_curves.png and X.ply go beside it (default: %(default)s)",
    )

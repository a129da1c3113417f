"""The options of `gsplat-edu demo`, and of `train/train_3d.py`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

from gsplat_edu.options.values import add_backend, whole_number_text

EXAMPLE = "example: gsplat-edu demo --iters 100 --size 48 --out out/quick.png"


class Budget(NamedTuple):
    """Iterations, cap on the number of Gaussians, and image size in px."""

    iters: int
    cap: int
    size: int


CHAPTER = Budget(iters=800, cap=1600, size=128)
"""The chapter's run."""

REDUCED = Budget(iters=300, cap=800, size=64)
"""Default of the dense backend torch: about a twentieth of the chapter's work."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""

    def number(flag: str, default: int, text: str) -> None:
        parser.add_argument(
            flag, type=whole_number_text, metavar="N", default=default, help=f"{text} (default: {default})"
        )

    for name, text in (
        ("iters", "training iterations"),
        ("cap", "maximum number of Gaussians"),
        ("size", "height and width of the images, px"),
    ):
        default = f"(default: {getattr(CHAPTER, name)}; {getattr(REDUCED, name)} with --backend torch)"
        parser.add_argument(f"--{name}", type=whole_number_text, metavar="N", help=f"{text} {default}")
    number("--k0", 400, "initial number of Gaussians")
    number("--seed", 9, "seed of the initial Gaussians, the splits and the view order")
    add_backend(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="X.png",
        default=Path("out/sphere.png"),
        help="figure to write; X_curves.png and X.ply are written beside it (default: %(default)s)",
    )

"""The options of `gsplat-edu clean`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.validation import in_range
from gsplat_edu.options.values import number_text

EXAMPLE = "example: gsplat-edu clean runs/plush --preview removed.html"

OFFERED = ("max_loss",)
"""Options that requests may give."""

MAX_LOSS = 0.05
"""dB: default of --max-loss."""

PREVIEW = ".html"
"""Suffix of the preview."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("source", type=Path, metavar="SCENE|RUN", help="scene file or run folder")
    parser.add_argument(
        "--dataset",
        type=Path,
        metavar="PATH",
        help="the capture that the scene was trained on; needed for a scene file, or if a run's capture has moved",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="file to write; its suffix selects the format, as for convert (default: NAME.clean.ply beside the scene)",
    )
    parser.add_argument(
        "--max-loss",
        type=number_text,
        default=MAX_LOSS,
        metavar="DB",
        help="largest loss of the held-out views' mean PSNR; less is removed to stay within it (default: %(default)s)",
    )
    parser.add_argument(
        "--preview",
        type=Path,
        metavar="FILE.html",
        help="also write a page of the scene in grey, with the removed splats in a colour for each reason",
    )
    parser.add_argument(
        "--edits",
        type=Path,
        metavar="FILE",
        help="carry the edits of the scene over to OUT, a PLY: they are written beside it, as edits.json",
    )
    parser.add_argument("--dry-run", action="store_true", help="report what would be removed; write no scene")


def check(arguments: argparse.Namespace) -> None:
    """Check the options that need no scene.

    Raises:
        ArgumentError: an option is out of range, or contradicts another.
        DatasetError: there is nothing under --dataset.
    """
    if arguments.edits is not None and (arguments.out is None or arguments.out.suffix.lower() != ".ply"):
        raise ArgumentError("--edits: fit only a PLY, whose splats stay exact; give one with --out")
    in_range("--max-loss", arguments.max_loss, 0.0)
    if arguments.dry_run and arguments.out is not None:
        raise ArgumentError("--dry-run: writes no scene; remove --out")
    if arguments.preview is not None and arguments.preview.suffix.lower() != PREVIEW:
        raise ArgumentError(f"--preview: {arguments.preview} is no page; give a name that ends in {PREVIEW}")
    if arguments.dataset is not None and not arguments.dataset.exists():
        raise DatasetError(f"--dataset: {arguments.dataset} does not exist; give the folder of a capture")

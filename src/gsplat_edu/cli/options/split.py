"""The options of `gsplat-edu split`: those of train, which every block is trained with."""

from __future__ import annotations

import argparse

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.cli.options import train
from gsplat_edu.cli.options.blocks import add_blocks

EXAMPLE = "example: gsplat-edu split captures/town --out runs/town --blocks 16 --quality high"

COMMON = (*train.COMMON[:-5], "blocks", "min_views", "coarse_iterations")
"""What `--help` shows; `--help-all` shows the other options too."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    train.add_training(parser)
    add_blocks(parser, "auto")


def check(arguments: argparse.Namespace) -> None:
    """Check the options as `train` does.

    Raises:
        ArgumentError: an option is out of range.
        CheckpointError: the config.json of a run to resume is damaged.
        DatasetError: there is nothing under DATA.
    """
    if arguments.export:
        raise ArgumentError("--export: the scene does not exist yet; give it to `gsplat-edu merge`")
    train.check(arguments)

"""The options of `gsplat-edu eval`."""

from __future__ import annotations

import argparse
from pathlib import Path

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.options.values import add_backend
from gsplat_edu.runs.folder import RunFolder

EXAMPLE = "example: gsplat-edu eval out/plush"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="run folder")
    parser.add_argument(
        "--dataset",
        type=Path,
        metavar="PATH",
        help="the run's capture, if its folder has moved; any other capture needs --out",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="write metrics, renders and report to this folder instead of the run",
    )
    add_backend(parser)


def check(arguments: argparse.Namespace) -> None:
    """Check that there is a run, and a dataset if one is named.

    Raises:
        CheckpointError: there is no run, or its config.json is damaged.
        DatasetError: there is nothing under --dataset.
    """
    RunFolder(arguments.run_folder).read_config()
    if arguments.dataset is not None and not arguments.dataset.exists():
        raise DatasetError(f"--dataset: {arguments.dataset} does not exist; give the folder of a capture")

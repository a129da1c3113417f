"""Depth that the user has, in a run: given to the views, and compared when the run is resumed."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.depths import CAPTURE, POINTS, DepthSource, with_depth
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.train.config import TrainConfig


def with_run_depth(
    dataset: Dataset,
    reader: CaptureReader,
    config: TrainConfig,
    depth: Path | None,
    points: Path | None,
    say: Callable[[str], None],
) -> Dataset:
    """Give the training views the depth that a run's options name, and say what was found.

    Args:
        dataset: The dataset of the run.
        reader: Its capture.
        config: Kind and unit of the depth.
        depth: The depth, as in `RunOptions`.
        points: The run's file of start points, if it has one.
        say: Receives sentences for the user.

    Raises:
        DatasetError: the depth cannot be used.
    """
    if depth is None:
        return dataset
    source = DepthSource(depth, config.depth_kind, config.depth_unit)
    dataset, report = with_depth(dataset, reader, source, points)
    for sentence in report.lines():
        say(sentence)
    return dataset


def depth_name(path: Path) -> str:
    """Return how config.json names the source of depth: the folder's full path, or the word."""
    return str(path if path in (POINTS, CAPTURE) else path.resolve())


def depth_digest(dataset: Dataset) -> str | None:
    """Return a digest of the depth of all training views; None if they have none."""
    digest, found = hashlib.sha256(), False
    for view in dataset.train:
        if view.depth is None:
            continue
        given, found = view.depth(), True
        digest.update(f"{view.name} {len(given)} {given.sparse}".encode())
        for array in (given.rays, given.depths, given.weights):
            digest.update(array.tobytes())
    return digest.hexdigest() if found else None


def check_depth(run: Path, stored: dict[str, Any], digest: str | None) -> None:
    """Compare the depth of a resumed run with that it was started with.

    Raises:
        CheckpointError: it differs.
    """
    if stored.get("depth") != digest:
        was = "without depth" if stored.get("depth") is None else "with other depth"
        raise CheckpointError(
            f"--resume: {run} was started {was}; give the same --depth with the same files, or another --out"
        )

"""Check that a capture's views are the ones that were split."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from gsplat_edu.base.errors import CheckpointError, DatasetError
from gsplat_edu.blocks.plan import Block, BlockPlan
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.runs.blocks_folder import BlocksFolder, file_digest
from gsplat_edu.runs.identity import photo_digests, views_difference


def write_views(folder: BlocksFolder, blocks: Sequence[Block], dataset: Dataset) -> dict[str, str]:
    """Write the cameras of the views of all blocks and the digests of their photos and masks.

    Args:
        folder: The run in blocks.
        blocks: The blocks.
        dataset: The capture.

    Returns:
        Names of the two files and their SHA-256, for `BlockPlan.views`.

    Raises:
        OSError: a file cannot be read or written.
    """
    run = folder.merged
    run.path.mkdir(parents=True, exist_ok=True)
    used = {name for block in blocks for name in (*block.train, *block.test)}
    train, test = (
        tuple(view for view in part if view.name in used) for part in (dataset.train, dataset.test)
    )
    run.write_cameras(train, test, dataset.origin)
    run.write_photos(photo_digests(dataclasses.replace(dataset, train=train, test=test)))
    return {path.name: file_digest(path) for path in (run.cameras, run.photos)}


def check_views(folder: BlocksFolder, plan: BlockPlan, dataset: Dataset) -> None:
    """Compare the views of a dataset with those that were split.

    Raises:
        CheckpointError: a file that `write_views` wrote is missing or was changed.
        DatasetError: photos are missing, or a photo, a mask or a camera was changed; the message names the first view.
        OSError: a file cannot be read.
    """
    for path in (folder.merged.cameras, folder.merged.photos):
        if not path.is_file() or file_digest(path) != plan.views.get(path.name):
            raise CheckpointError(f"{path}: is missing or not as it was split; restore it, or split again")
    if not np.array_equal(dataset.origin, plan.origin):
        raise DatasetError(f"{dataset.path}: photos that the plan knows are missing here; copy them here")
    if (found := views_difference(folder.merged, dataset)) is not None:
        raise DatasetError(
            f"{dataset.path}: is not as it was split: {found}; restore the capture, or split again"
        )

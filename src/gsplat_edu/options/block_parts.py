"""The runs of which a training in blocks consists, as the arguments of `gsplat-edu train`."""

from __future__ import annotations

import argparse

from gsplat_edu.data.settings import FACTOR_BELOW
from gsplat_edu.options.blocks import COARSE_FACTOR, COARSE_SHARE
from gsplat_edu.options.length import length_of, strategy_of
from gsplat_edu.runs.blocks_folder import BlocksFolder
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.train.config import FOR_START, WITH_OPTION, TrainConfig
from gsplat_edu.train.strategy_config import FastConfig


def parts_of_blocks(arguments: argparse.Namespace) -> tuple[argparse.Namespace, argparse.Namespace | None]:
    """Return the arguments of each block's run, and those of the coarse model's; None where --from gives one.

    The coarse run has photos smaller by `COARSE_FACTOR`, and its own length.

    Args:
        arguments: Those of a run in blocks.
    """
    of_block = argparse.Namespace(**vars(arguments))
    of_block.resume, of_block.scene = False, arguments.scene or arguments.out
    kept = {name: value for name, value in arguments.settings.items() if name not in FOR_START}
    of_block.settings = {"means_rate": TrainConfig.means_rate, **kept}  # a coarse model is not in place yet
    if (
        arguments.scene is None and strategy_of(arguments) == "fast"
    ):  # and has no detail that small photos would undo
        of_block.settings = {"fast_start_factor": FastConfig.start_factor, **of_block.settings}
    for name in set(FOR_START) & set(WITH_OPTION):
        setattr(of_block, name, None)
    coarse = argparse.Namespace(**vars(arguments))
    if arguments.scene is not None:
        return of_block, None
    length = length_of(arguments, strategy_of(arguments))
    coarse.iterations = arguments.coarse_iterations or max(round(COARSE_SHARE * length), 1)
    coarse.quality, coarse.out = None, BlocksFolder(arguments.out).coarse
    coarse.resume = RunFolder(coarse.out).exists()
    if arguments.max_gaussians is not None:
        coarse.max_gaussians = max(round(arguments.max_gaussians / COARSE_FACTOR**2), 1)
    size = arguments.resolution
    if size is None or size < FACTOR_BELOW:
        coarse.resolution = min(COARSE_FACTOR * (size or 1.0), FACTOR_BELOW - 1)
    else:
        coarse.resolution = max(size / COARSE_FACTOR, FACTOR_BELOW)
    return of_block, coarse

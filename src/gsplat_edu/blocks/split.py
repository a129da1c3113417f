"""Prepare a run in blocks: split the ground with a coarse model, and write what each block starts from."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.blocks.counted import Counted
from gsplat_edu.blocks.plan import Block, BlockPlan, automatic_count, measured_area
from gsplat_edu.blocks.same import write_views
from gsplat_edu.blocks.views import LEAST_VIEWS, assigned, feature_renderer, seen_shares
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.io.ply import save_ply
from gsplat_edu.runs.blocks_folder import PLAN, BlocksFolder, file_digest
from gsplat_edu.runs.dataset import reader_for
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.start import scene_file, scene_start
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.train.capacity import wanted_gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.length import planned_iterations
from gsplat_edu.train.overlap import separate_views

OPAQUE = 0.1
"""Gaussians of the coarse model above this opacity count as points of the scene."""

ROOM = 1.5
"""fast: the cap of a block is at least this multiple of its start Gaussians."""

MARGIN_ROOM = 1.1
"""Number of Gaussians for a cell with its margin, as a multiple of that for the cell. Merging removes those of the
margin, and keeps the cap of the whole (`gsplat_edu.blocks.merge`)."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class SplitOptions:
    """How a capture is split.

    Args:
        count: Number of blocks; None chooses it from the number of training views.
        least_views: Smallest number of training views of a block.
        quality: Of `gsplat_edu.train.length.QUALITIES`: the length of each block follows from its own views; None for
            the iterations of the options.
    """

    count: int | None = None
    least_views: int = LEAST_VIEWS
    quality: str | None = None

    def iterations_of(self, views: int, batch: int) -> int | None:
        """Return the iterations for a block with this number of training views; None for the options'."""
        return None if self.quality is None else planned_iterations(self.quality, views, batch=batch)


def recipe_of(options: RunOptions) -> dict[str, Any]:
    """Return the options of the blocks that a plan stores."""
    return {
        "train": options.config.record(),
        "data": dataclasses.asdict(options.data_settings),
        "backend": options.backend,
        "eval_every": options.eval_every,
        "save_every": options.save_every,
    }


MAY_DIFFER = ("data.image_memory", "eval_every", "save_every")
"""Options that a resumed command may change."""

CHOSEN = ("data.left_out", "data.region", "data.reading")
"""Options that the first command may have chosen from the capture; one that does not give them keeps the choice."""


def check_recipe(folder: Path, plan: BlockPlan, options: RunOptions) -> None:
    """Compare the options of a resumed command with those of the plan.

    Raises:
        CheckpointError: one differs; the message names it.
    """
    stored, given = (_flat(recipe) for recipe in (plan.recipe, recipe_of(options)))
    for key, value in given.items():
        if key in MAY_DIFFER or (key in CHOSEN and value is None):
            continue
        if stored.get(key) != value:
            raise CheckpointError(
                f"--resume: {folder / PLAN} was made with {key} = {stored.get(key)}, not {value}; give the same"
                " options or another --out"
            )


def _check_region(dataset: Dataset) -> None:
    if dataset.region is not None:
        raise ArgumentError(
            "--blocks: cannot train in the box of the capture's region.json only; add --set region=none"
        )


def split_capture(
    options: RunOptions, coarse: Path, split: SplitOptions, say: Say, reader: CaptureReader | None = None
) -> BlockPlan:
    """Split a capture into blocks, and write the plan and what each block starts from.

    Args:
        options: Options of the run in blocks; its config is that of each block.
        coarse: The coarse model: a scene file or a run.
        split: How to split.
        say: Receives sentences for the user.
        reader: Has read the capture already; None to read it.

    Raises:
        DatasetError: the capture cannot be read.
        ArgumentError: the coarse model has too many Gaussians, or no usable one.
        OSError: a file cannot be written.
    """
    folder, config = BlocksFolder(options.out), options.config
    dataset = Dataset.of(reader_for(options, reader), options.data_settings)
    _check_region(dataset)
    for note in dataset.notes:
        say(str(note))
    gaussians = _coarse_gaussians(coarse, config, dataset, say)
    means = gaussians.means.double().numpy()
    solid = (gaussians.opacities.numpy() > OPAQUE) & ~far_shell(means)
    points = means[solid if solid.any() else slice(None)]
    area = measured_area([view.camera for view in dataset.train], points)
    wanted = automatic_count(len(dataset.train)) if split.count is None else split.count
    renderer = feature_renderer(options)
    measure = functools.partial(seen_shares, area, gaussians, renderer)
    blocks = assigned(dataset, area, points, wanted, measure, split.least_views)
    if split.count is not None and len(blocks) < wanted:
        say(
            f"{wanted} blocks would have fewer than {split.least_views} training views: the capture is split into"
            f" {len(blocks)}"
        )
    cameras = {view.name: view.camera for view in dataset.train}
    places = area.ground.coordinates(means)
    made = []
    for number, block in enumerate(blocks):
        counted = Counted(area, block.core, gaussians, renderer)
        kept = torch.from_numpy(np.flatnonzero(counted.start([cameras[name] for name in block.train])))
        start = gaussians.map(functools.partial(torch.index_select, dim=0, index=kept))
        save_ply(folder.start(number), start, dataset.origin, config.antialiased)
        inside = int(block.core.holds(places).sum())
        cap = _cap(options, dataset, block, len(kept) - inside, inside, len(gaussians))
        views = len(block.train)
        length = split.iterations_of(views, config.batch)
        digest = file_digest(folder.start(number))
        made.append(dataclasses.replace(block, start=digest, max_gaussians=cap, iterations=length))
        say(
            f"block {number}: {views} training views, {len(block.test)} held out, {len(kept):,} Gaussians to start"
            f" from, {length or config.iterations:,} iterations"
        )
    x, y, z = dataset.origin.tolist()
    capture = str(options.data.resolve())
    known = write_views(folder, made, dataset)
    plan = BlockPlan(capture, (x, y, z), area, tuple(made), recipe_of(options), known)
    plan.write(folder.path)  # last: its presence means that everything else is there
    return plan


def _coarse_gaussians(coarse: Path, config: TrainConfig, dataset: Dataset, say: Say) -> Gaussians:
    """Read the coarse model; refuse it if it exceeds the cap."""
    gaussians, notes = scene_start(coarse, config.changed(max_gaussians=None), dataset.origin)
    for note in notes:
        say(note)
    if config.max_gaussians is not None and config.max_gaussians < len(gaussians):
        raise ArgumentError(
            f"--max-gaussians: is {config.max_gaussians}, but the coarse model has {len(gaussians)} already; raise it,"
            " or give a smaller one with --from"
        )
    return gaussians


def _cap(
    options: RunOptions, dataset: Dataset, block: Block, outside: int, inside: int, all_gaussians: int
) -> int | None:
    """Return the cap of a block: its cell's share of the scene's cap and room for the margin, or the recipe's plan.

    Gaussians outside the cell hide parts of it. Their pixels do not count, so their number stays.

    Args:
        options: Options of the run in blocks.
        dataset: The capture.
        block: The block.
        outside: Number of start Gaussians outside the cell.
        inside: Number of start Gaussians in the cell.
        all_gaussians: Number of Gaussians of the coarse model.
    """
    config = options.config
    if config.max_gaussians is not None:
        share = inside / all_gaussians
        return max(round(MARGIN_ROOM * config.max_gaussians * share), inside, 1) + outside
    if config.strategy != "fast":
        return None
    pixels = np.mean([view.camera.W * view.camera.H for view in dataset.train])
    names, start = set(block.train), inside + outside
    separate = separate_views([view.camera for view in dataset.train if view.name in names], dataset.points)
    planned = wanted_gaussians(config, start, float(pixels), len(block.train), separate)
    return max(planned, int(ROOM * start))


def coarse_scene(options: RunOptions) -> Path:
    """Return the scene of a coarse model that was given, or of the run that was trained for it."""
    return scene_file(options.scene or BlocksFolder(options.out).coarse)


def _flat(recipe: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in recipe.items():
        parts = value if isinstance(value, dict) else {"": value}
        for name, entry in parts.items():
            found[f"{key}.{name}".rstrip(".")] = list(entry) if isinstance(entry, tuple) else entry
    return found

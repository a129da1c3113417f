"""Merge trained blocks: each keeps the Gaussians of its cell, in the order of the blocks."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.base.links import check_links
from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.blocks.same import check_views
from gsplat_edu.blocks.seams import pooled_psnr, strip_masks, strip_width
from gsplat_edu.blocks.task import block_options
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.io.formats import read_scene, write_scene
from gsplat_edu.render.api import render
from gsplat_edu.runs.blocks_folder import BlocksFolder, Done, file_digest
from gsplat_edu.runs.dataset import reader_for
from gsplat_edu.runs.evaluation import Evaluation, Progress, ScoredViews, evaluate_run
from gsplat_edu.runs.identity import fingerprint
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.source import capture_scene, capture_up, open_source
from gsplat_edu.runs.training import Export, document
from gsplat_edu.scene.gaussians import Gaussians

Say = Callable[[str], None]


def finished_blocks(folder: BlocksFolder, plan: BlockPlan) -> list[Done]:
    """Return the records of all blocks.

    Raises:
        CheckpointError: a block is not finished, or its scene is not the one of its record.
    """
    found = [folder.read_done(number, plan.digest()) for number in range(len(plan.blocks))]
    if missing := [str(number) for number, done in enumerate(found) if done is None]:
        names = ", ".join(missing)
        raise CheckpointError(
            f"{folder.path}: {len(missing)} of {len(found)} blocks are not trained yet: {names}; train each with"
            f" `gsplat-edu block {folder.path} {missing[0]}`"
        )
    records = [done for done in found if done is not None]
    for done in records:
        scene = folder.scene(done.block, done.iterations)
        if not scene.is_file() or file_digest(scene) != done.sha256:
            raise CheckpointError(
                f"{scene}: is missing or was changed after the training; restore it, or remove"
                f" {folder.record(done.block)} and train the block again"
            )
    return records


def merged(folder: BlocksFolder, plan: BlockPlan, records: list[Done]) -> tuple[Gaussians, list[int]]:
    """Concatenate the Gaussians that lie in the cell of their block, in the order of the blocks, and keep the cap.

    Args:
        folder: The run in blocks.
        plan: Its plan.
        records: Of all blocks, in order.

    Returns:
        The scene, relative to the plan's origin; and the number of Gaussians from each block.
    """
    parts = []
    for block, done in zip(plan.blocks, records, strict=True):
        gaussians = read_scene(folder.scene(done.block, done.iterations)).relative_to(plan.origin)
        places = plan.area.ground.coordinates(gaussians.means.numpy())
        stays = torch.from_numpy(np.flatnonzero(block.core.holds(places)))
        parts.append(gaussians.map(functools.partial(torch.index_select, dim=0, index=stays)))
    cap = plan.recipe["train"].get("max_gaussians")
    if cap is not None and sum(map(len, parts)) > cap:
        parts = _within_cap(parts, int(cap))
    return Gaussians.concatenated(parts), [len(part) for part in parts]


def _within_cap(parts: list[Gaussians], cap: int) -> list[Gaussians]:
    """Remove the Gaussians with the smallest opacity times area until a cap is met.

    Args:
        parts: The Gaussians of each block.
        cap: Most Gaussians of all parts.
    """
    covers = []
    for part in parts:
        two_largest = part.log_scales.detach().double().numpy()
        two_largest = np.sort(two_largest, axis=1)[:, 1:].sum(axis=1)
        covers.append(np.log(part.opacities.detach().double().numpy()) + two_largest)
    ranks = np.argsort(-np.concatenate(covers), kind="stable")
    kept = np.zeros(len(ranks), dtype=bool)
    kept[ranks[:cap]] = True
    found = []
    for part, stays in zip(parts, np.split(kept, np.cumsum([len(part) for part in parts])[:-1]), strict=True):
        rows = torch.from_numpy(np.flatnonzero(stays))
        found.append(part.map(functools.partial(torch.index_select, dim=0, index=rows)))
    return found


def merge_blocks(
    path: Path,
    say: Say = lambda sentence: None,
    reader: CaptureReader | None = None,
    progress: Progress | None = None,
    export: Export | None = None,
) -> Evaluation:
    """Merge the blocks of a run, write the scene into its folder, and score it on the held-out views if its plan does.

    Args:
        path: Folder of the run in blocks.
        say: Receives sentences for the user.
        reader: Reads the capture, from where it is on this machine; None to read it from the path in the plan.
        progress: Called for every scored view.
        export: As for `CaptureRun.finish`.

    Raises:
        ArgumentError: a link leads out of the folder.
        CheckpointError: a block is not finished, or a file is damaged.
        DatasetError: the capture cannot be read.
        OSError: a file cannot be written.
    """
    check_links("RUN", path)
    folder, plan = BlocksFolder(path), BlockPlan.read(path)
    records = finished_blocks(folder, plan)
    if len(kinds := sorted({(done.instructions, done.version) for done in records})) > 1:
        named = ", ".join(" with version ".join(kind) for kind in kinds)
        say(f"blocks were trained by different kernels ({named}): other machines may round to other bytes")
    gaussians, counts = merged(folder, plan, records)
    options = _whole(folder, plan, None if reader is None else reader.path)
    dataset = Dataset.of(reader_for(options, reader), options.data_settings)
    steps = max(done.iterations for done in records)
    run = folder.merged
    check_views(folder, plan, dataset)
    scene = run.scene(steps)
    write_scene(scene, capture_scene(gaussians, dataset, options.config.antialiased))
    run.write_config(_config(options, plan, dataset))
    say(f"wrote {scene}: {len(gaussians):,} Gaussians from {len(records)} blocks")
    settings = dataclasses.replace(options.render_settings, depth=True)
    renderer = functools.partial(render, settings=settings, backend=options.backend)
    facts: dict[str, Any] = {
        "iterations": steps,
        "seconds": round(sum(done.seconds for done in records), 3),
        "blocks": _facts(plan, records, counts, dataset),
        "seams": None,
    }
    if len(records) > 1 and dataset.test and options.scores_at_end:
        masks = strip_masks(
            plan.area, plan.cores, gaussians, [view.camera for view in dataset.test], renderer
        )
        strips, rest = pooled_psnr(gaussians, dataset.test, masks, renderer, options.config.background)
        width = 2 * strip_width(plan.area, plan.cores)
        facts["seams"] = {"width": width, "psnr": strips, "psnr_elsewhere": rest}
    if export is not None:
        facts["exports"] = export(open_source(scene))
    judged = ScoredViews(
        dataset.test, (), options.config.background, dataset.notes, skipped=not options.scores_at_end
    )
    return evaluate_run(run, judged, gaussians, options.renderer, facts, progress)


def _whole(folder: BlocksFolder, plan: BlockPlan, data: Path | None) -> RunOptions:
    """Return the options of the merged run: those of a block with the views of all blocks."""
    one = block_options(folder, plan, 0, data)
    train, test = (
        tuple(sorted({name for block in plan.blocks for name in getattr(block, part)}))
        for part in ("train", "test")
    )
    settings = dataclasses.replace(one.data_settings, train_views=train, test_views=test)
    return dataclasses.replace(one, out=folder.path, data_settings=settings)


def _config(options: RunOptions, plan: BlockPlan, dataset: Dataset) -> dict[str, Any]:
    config = document(options)
    config["train"]["max_gaussians"] = plan.recipe["train"].get("max_gaussians")
    facts: dict[str, Any] = {"origin": list(plan.origin), "up": list(capture_up(dataset))}
    facts |= {"fingerprint": fingerprint(dataset), "blocks": len(plan.blocks)}
    return config | facts | ({} if dataset.scale is None else {"scale": dataset.scale.json()})


def _facts(plan: BlockPlan, records: list[Done], counts: list[int], dataset: Dataset) -> dict[str, Any]:
    """Return the part of metrics.json from which the report draws the cells."""
    area = plan.area
    eyes = area.ground.coordinates(np.stack([view.camera.eye for view in dataset.train]))
    return {
        "low": list(area.low),
        "high": list(area.high),
        "cameras": np.round(eyes[:, :2], 3).tolist(),
        "cells": [
            block.core.json()
            | {
                "train_views": len(block.train),
                "test_views": list(block.test),
                "gaussians": count,
                "trained": done.gaussians,
                "seconds": done.seconds,
                "peak_memory": done.peak_memory,
            }
            for block, done, count in zip(plan.blocks, records, counts, strict=True)
        ],
    }

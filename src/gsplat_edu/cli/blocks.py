"""`gsplat-edu train --blocks`: split a capture, train its blocks here or on a cluster, and merge them."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.base.links import check_links
from gsplat_edu.base.locks import locked
from gsplat_edu.base.reading import stored_path
from gsplat_edu.blocks.cluster import AGAIN, ClusterOptions, run_on_cluster
from gsplat_edu.blocks.merge import merge_blocks
from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.blocks.split import SplitOptions, check_recipe, coarse_scene, split_capture
from gsplat_edu.blocks.task import train_block
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.block_table import BlockTable
from gsplat_edu.cli.eval import result_lines, verdict_line
from gsplat_edu.cli.exporting import export_all
from gsplat_edu.cli.findings import with_right_poses
from gsplat_edu.cli.process import interruptible
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.cli.train import (
    photos_read,
    progress_bar,
    train_with_bar,
    with_choices,
    with_points,
    with_poses,
)
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.evaluate.metrics import ImageScore
from gsplat_edu.options.block_parts import parts_of_blocks
from gsplat_edu.options.blocks import LEAST_VIEWS, SPLIT, block_count
from gsplat_edu.options.length import quality_of
from gsplat_edu.options.train import OPEN, left_open, options_from
from gsplat_edu.runs.blocks_folder import BlocksFolder
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.training import CaptureRun, is_finished
from gsplat_edu.train.config import FOR_START
from gsplat_edu.viewer.export import check_target

Say = Callable[[str], None]


def run(arguments: argparse.Namespace) -> None:
    """Split, train every block, merge and report; or only split."""
    console = Terminal()
    say = console.say
    for path in arguments.export:
        check_target("--export", path)
    cluster = None
    if arguments.scheduler is not None or (arguments.workers or 1) > 1:
        cluster = ClusterOptions(arguments.scheduler, arguments.workers or 1)
    check_links("--out", arguments.out)
    with locked("--out", arguments.out, "gsplat-edu train --blocks", say):
        planned, reader = _prepared(arguments, console)
        folder = BlocksFolder(arguments.out)
        if arguments.until == SPLIT:
            last = len(planned.blocks) - 1
            say(
                f"wrote {arguments.out}: train blocks 0 to {last} with `gsplat-edu block {arguments.out} K`, on any"
                f" machine that sees it; then `gsplat-edu merge {arguments.out}`"
            )
            return
        with BlockTable(console, folder, planned) as table:
            if cluster is None:
                _train_here(folder, planned, reader, table)
            else:
                _train_there(folder, planned, cluster, table, say)
        if is_merged(folder):
            say(f"{folder.path}: is finished, {len(planned.blocks)} blocks; nothing to do")
            return
        merge_and_report(arguments.out, arguments.export, console, reader)


def _prepared(arguments: argparse.Namespace, console: Terminal) -> tuple[BlockPlan, CaptureReader | None]:
    """Return the plan of a run in blocks; train the coarse model and split the capture if there is none yet.

    The second value reads the capture; it is None if the plan names none on this computer.

    Raises:
        CheckpointError: the folder holds another run, or the options differ from its plan.
    """
    folder, say = BlocksFolder(arguments.out), console.say
    of_block, of_coarse = parts_of_blocks(arguments)
    options = options_from(of_block)
    exists = folder.plan.is_file()
    if (exists or folder.merged.exists()) and not arguments.resume:
        raise CheckpointError(
            f"--out: {folder.path} already holds a run; add --resume to continue it, or give another folder"
        )
    if exists:
        stored = BlockPlan.read(folder.path)
        chosen = stored.recipe.get("train", {})
        still_open = {n: chosen[n] for n in OPEN if getattr(of_block, n) in (None, "auto") and n in chosen}
        check_recipe(folder.path, stored, replace(options, config=options.config.changed(**still_open)))
        capture = stored_path(stored.capture)
        return stored, None if capture is None else CaptureReader(capture)
    if folder.merged.exists():
        raise CheckpointError(f"--out: {folder.path} holds a run that is not in blocks; give another folder")
    options = with_poses(options, arguments, console, say)
    reader = CaptureReader(options.data)
    options, reader = with_right_poses(options, reader, arguments, say)
    if of_coarse is not None:
        coarse = replace(options_from(of_coarse), data=options.data)
        chosen = options.data_settings
        settings = replace(coarse.data_settings, left_out=chosen.left_out, reading=chosen.reading)
        coarse = replace(coarse, data_settings=settings)
        coarse = with_points(coarse, reader, None, console, say)
        if not coarse.resume:
            names = left_open(of_coarse)
            coarse = with_choices(coarse, reader, names, console, say)
            shared = {name: getattr(coarse.config, name) for name in names if name not in FOR_START}
            options = replace(options, config=options.config.changed(**shared))
        else:
            options = replace(options, config=options.config.changed(**_chosen_before(coarse, of_block)))
        _train_coarse(coarse, reader, console)
    split = SplitOptions(block_count(arguments), arguments.min_views or LEAST_VIEWS, quality_of(arguments))
    scene = coarse_scene(replace(options, scene=arguments.scene))
    return split_capture(replace(options, scene=None), scene, split, say, reader), reader


def _chosen_before(coarse: RunOptions, of_block: argparse.Namespace) -> dict[str, object]:
    """Return the values that an interrupted coarse run chose for open settings."""
    stored = coarse.folder.read_config().get("train", {})
    names = [name for name in OPEN if name not in FOR_START and getattr(of_block, name) in (None, "auto")]
    return {name: stored[name] for name in names if name in stored}


def _train_coarse(options: RunOptions, reader: CaptureReader, console: Terminal) -> None:
    """Train the coarse model of the whole capture, in a run folder of its own."""
    console.say(
        f"training a coarse model of the whole: {options.config.iterations} iterations, {options.out}"
    )
    given = ["max_gaussians"] if options.config.max_gaussians is not None else []
    options = plan(options, Limits(), given, reader=reader).options
    if is_finished(options):
        return
    with interruptible() as interrupted:
        with progress_bar(console, "") as bar:
            capture = CaptureRun(options, console.say, photos_read(bar, interrupted), reader=reader)
        with progress_bar(console, "{task.fields[state]}") as bar:
            train_with_bar(capture, bar, interrupted, [])
        if interrupted():
            raise KeyboardInterrupt(f"interrupted in the coarse training; {AGAIN}")
        capture.finish()


def _train_here(
    folder: BlocksFolder, planned: BlockPlan, reader: CaptureReader | None, table: BlockTable
) -> None:
    """Train the blocks in this process, one after the other."""
    with interruptible() as interrupted:
        for number in range(len(planned.blocks)):
            if train_block(folder.path, number, reader, stop=interrupted) is None:
                raise KeyboardInterrupt(f"interrupted in block {number}; {AGAIN}")
            table.look()


def _train_there(
    folder: BlocksFolder, planned: BlockPlan, cluster: ClusterOptions, table: BlockTable, say: Say
) -> None:
    """Train the unfinished blocks on a cluster, blocks with the most views first."""
    digest = planned.digest()
    rest = [n for n in range(len(planned.blocks)) if folder.read_done(n, digest) is None]
    rest.sort(key=lambda number: (-len(planned.blocks[number].train), number))
    if not rest:
        return
    try:
        run_on_cluster(folder.path, rest, cluster, table.look, say)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {AGAIN}") from None


def is_merged(folder: BlocksFolder) -> bool:
    """Return whether the blocks are merged and scored."""
    return folder.merged.exists() and folder.merged.metrics.is_file()


def merge_and_report(
    path: Path, exports: list[Path], console: Terminal, reader: CaptureReader | None = None
) -> None:
    """Merge the blocks of a run and print the scores.

    Args:
        path: Folder of the run in blocks.
        exports: Files to write in other formats.
        console: The terminal.
        reader: Reads the capture, from where it is on this machine; None to read it from the path in the plan.
    """
    recipe, say = BlockPlan.read(path).recipe, console.say
    with progress_bar(console, "") as bar:
        task = bar.add_task("evaluating", total=None)

        def scored(split: str, score: ImageScore) -> None:
            bar.advance(task)

        export = (
            functools.partial(export_all, exports, bar, str(recipe.get("backend")), say) if exports else None
        )
        result = merge_blocks(path, say, reader, scored, export)
    for line in result_lines(result, BlocksFolder(path).merged):
        say(line)
    seams = result.metrics["seams"]
    if seams is not None and seams["psnr"] is not None:
        say(f"along the cuts: PSNR {seams['psnr']:.2f} dB, elsewhere {seams['psnr_elsewhere']:.2f} dB")
    say(f"wrote {BlocksFolder(path).merged.report}")
    say(verdict_line(result, BlocksFolder(path).merged))

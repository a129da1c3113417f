"""Train one block: an ordinary run, and a record that is renamed into place when it is finished."""

from __future__ import annotations

import dataclasses
import functools
import platform
import socket
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.links import check_links
from gsplat_edu.base.locks import locked
from gsplat_edu.base.reading import stored_path
from gsplat_edu.base.validation import one_of
from gsplat_edu.blocks.counted import Counted, counted_views
from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.blocks.same import check_views
from gsplat_edu.blocks.views import feature_renderer
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.io.formats import read_scene
from gsplat_edu.ops.kernels import REASON, native
from gsplat_edu.render.settings import BACKENDS
from gsplat_edu.runs.blocks_folder import BlocksFolder, Done, file_digest
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.config import TrainConfig, stretched
from gsplat_edu.train.trainer import Callback

Say = Callable[[str], None]


def block_options(folder: BlocksFolder, plan: BlockPlan, number: int, data: Path | None = None) -> RunOptions:
    """Return the options of a block's run.

    Args:
        folder: The run in blocks.
        plan: Its plan.
        number: The block.
        data: Where the capture is on this machine; None for the path in the plan.

    Raises:
        ArgumentError: there is no such block.
        CheckpointError: the plan's recipe is damaged, or its capture is not on this computer.
    """
    if not 0 <= number < len(plan.blocks):
        raise ArgumentError(f"block: is {number}, but the plan has blocks 0 to {len(plan.blocks) - 1}")
    block = plan.blocks[number]
    capture = stored_path(plan.capture) if data is None else data
    if capture is None:
        raise CheckpointError(
            f"{folder.plan}: capture: is not a path of this computer; name the capture with --data PATH"
        )
    try:
        settings = _tuples(plan.recipe["data"])
        one_of("backend", plan.recipe["backend"], BACKENDS)
        config = TrainConfig.of_record(plan.recipe["train"] | {"max_gaussians": block.max_gaussians})
        if block.iterations is not None:
            config = stretched(config, block.iterations)
        views = {"train_views": block.train, "test_views": block.test}
        return RunOptions(
            data=capture,
            out=folder.run(number).path,
            config=config,
            data_settings=DataSettings(**settings | views),
            scene=folder.start(number),
            backend=plan.recipe["backend"],
            eval_every=plan.recipe["eval_every"],
            save_every=plan.recipe["save_every"],
            resume=folder.run(number).exists(),
        )
    except (KeyError, TypeError, ArgumentError) as error:
        raise CheckpointError(f"{folder.path}: the plan's recipe is damaged ({error}); split again") from None


def train_block(
    path: Path,
    number: int,
    reader: CaptureReader | None = None,
    say: Say = lambda sentence: None,
    stop: Callable[[], bool] = lambda: False,
    callbacks: Sequence[Callback] = (),
    patience: float = 0.0,
) -> Done | None:
    """Train a block to the end, from its last checkpoint if it has one. A finished block is not trained again.

    Args:
        path: Folder of the run in blocks.
        number: The block.
        reader: Reads the capture, from where it is on this machine; None to read it from the path in the plan.
        say: Receives sentences for the user.
        stop: Called after every iteration; if it returns true, the block is saved and can be resumed.
        callbacks: Receive every step.
        patience: Seconds to wait for another process that trains the block.

    Returns:
        The record; None if `stop` ended the training.

    Raises:
        ArgumentError: there is no such block, another process is training it, or a link leads out of the folder.
        CheckpointError: plan, start or run are damaged.
        DatasetError: a photo is missing, cannot be read here, or was changed since the capture was split.
        OSError: a file cannot be written, for example because the disk is full.
    """
    folder = BlocksFolder(path)
    plan = BlockPlan.read(path)
    options = block_options(folder, plan, number, None if reader is None else reader.path)
    check_links("RUN", path)
    if (done := folder.read_done(number, plan.digest())) is not None:
        return done
    with locked(f"block {number}", options.out, "a training of this block", say, patience):
        if (done := folder.read_done(number, plan.digest())) is not None:
            return done  # another process may have finished the block while this one waited for the lock
        start = folder.start(number)
        if not start.is_file() or file_digest(start) != plan.blocks[number].start:
            raise CheckpointError(f"{start}: is missing or not as it was split; restore it, or split again")
        prepare = functools.partial(_prepared, folder, plan, number, options)
        capture = CaptureRun(options, say, prepare=prepare, reader=reader)
        if capture.train(stop, callbacks):
            return None
        capture.finish()
        done = _record(folder, plan, number, capture)
        done.write(folder)  # last: it marks the block as finished
    return done


def pixels_of_block(folder: BlocksFolder, plan: BlockPlan, number: int, options: RunOptions) -> Counted:
    """Return what finds the pixels that count in a block, by the Gaussians from which it starts.

    Args:
        folder: The run in blocks.
        plan: Its plan.
        number: The block.
        options: Those of `block_options`.
    """
    start = read_scene(folder.start(number)).relative_to(plan.origin)
    return Counted(plan.area, plan.blocks[number].core, start, feature_renderer(options))


def _prepared(
    folder: BlocksFolder, plan: BlockPlan, number: int, options: RunOptions, dataset: Dataset
) -> Dataset:
    """Return the block's dataset, in which the pixels count that show its cell; refuse one that was not split.

    Raises:
        CheckpointError: a file of the split is missing or was changed.
        DatasetError: the capture is not the one that was split.
    """
    check_views(folder, plan, dataset)
    if len(plan.blocks) == 1:
        return dataset
    counted = pixels_of_block(folder, plan, number, options)
    return dataclasses.replace(dataset, train=counted_views(dataset.train, counted))


def _record(folder: BlocksFolder, plan: BlockPlan, number: int, capture: CaptureRun) -> Done:
    scene = capture.folder.scene(capture.trainer.iteration)
    return Done(
        block=number,
        plan=plan.digest(),
        sha256=file_digest(scene),
        gaussians=int(capture.folder.read_metrics()["num_gaussians"]),
        iterations=capture.trainer.iteration,
        seconds=round(capture.seconds, 3),
        peak_memory=_peak_memory(),
        host=socket.gethostname(),
        instructions=_instructions(),
        version=version("gsplat-edu"),
    )


def _instructions() -> str:
    return platform.machine() if REASON is not None else f"{platform.machine()} {native().isa()}"


def _peak_memory() -> int:
    """Return the largest resident memory of this process so far, bytes; 0 if the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(most if platform.system() == "Darwin" else 1024 * most)


def _tuples(section: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in section.items()}

"""Choose the iterations of a run from its capture: more for more photos, fewer if a trial overfits."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

from gsplat_edu.budget.deadline import TrialTime
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.thin import ThinTrial, needs_trial, try_lengths
from gsplat_edu.train.config import MILESTONES, TrainConfig, recipe
from gsplat_edu.train.length import planned_iterations, reasons


def with_iterations(
    config: TrainConfig, iterations: int, given: Collection[str] = (), *, rescale: bool = True
) -> TrainConfig:
    """Return a configuration for another number of iterations.

    Args:
        config: The run.
        iterations: New number, of which whole batches count.
        given: Names of settings that the user gave, which stay.
        rescale: Whether milestones that are not given stretch with the iterations.
    """
    iterations = max(iterations // config.batch, 1) * config.batch
    fresh = recipe(iterations, rescale=rescale, strategy=config.strategy).flat()
    scaled = {name: fresh[name] for name in (*MILESTONES, "densify_every") if name not in given}
    return config.changed(iterations=iterations, **scaled)


def tried(
    options: RunOptions,
    reader: CaptureReader,
    views: int,
    progress: Callable[[], None] = lambda: None,
    time: TrialTime | None = None,
) -> ThinTrial | None:
    """Try how long a training by the recipe fast may be; None if there are enough photos, or too few to try.

    Args:
        options: The run; one that is resumed, starts from a scene, or has another recipe is not tried.
        reader: The run's capture.
        views: Number of training views.
        progress: Called after every iteration of a trial.
        time: Trials end when it is over; None for no limit.

    Raises:
        DatasetError: one of the photos cannot be read.
    """
    fresh = options.scene is None and not options.resume
    if options.config.strategy != "fast" or not fresh or not needs_trial(views):
        return None
    if time is None:
        return try_lengths(options, reader, progress)
    return try_lengths(options, reader, progress, time.is_over)


def with_planned_length(
    options: RunOptions,
    quality: str,
    reader: CaptureReader,
    given: Collection[str] = (),
    *,
    rescale: bool = True,
    progress: Callable[[], None] = lambda: None,
) -> tuple[RunOptions, str]:
    """Choose the iterations of a run of the recipe fast.

    Args:
        options: The run.
        quality: A key of `gsplat_edu.train.length.QUALITIES`.
        reader: The run's capture.
        given: Names of settings that the user gave, which stay.
        rescale: Whether milestones that are not given stretch with the iterations.
        progress: Called after every iteration of a trial; captures of few photos are tried.

    Returns:
        The run with its length, and a sentence that says how long it is and why.

    Raises:
        DatasetError: the capture or one of its photos cannot be read.
    """
    dataset = Dataset.of(reader, options.data_settings, points=options.points)
    views = len(dataset.train)
    measured = dataset.measured or options.scene is not None
    iterations = planned_iterations(quality, views, measured, options.config.batch)
    why = reasons(views, measured)
    trial = tried(options, reader, views, progress)
    if trial is not None and trial.longest is not None and trial.longest < iterations:
        iterations, why = trial.longest + -trial.longest % options.config.batch, str(trial)
    config = with_iterations(options.config, iterations, given, rescale=rescale)
    said = f"{quality} is {config.iterations:,} iterations ({why}); --iterations changes that"
    return replace(options, config=config), said

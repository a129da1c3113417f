"""Let a part of a training choose its setting by short trainings on small photos: pilots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.evaluate.alignment import scored_halves
from gsplat_edu.parts.bench import Bench, OutOfTimeError
from gsplat_edu.parts.run_values import Tried
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.dataset import as_trained
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.train.config import BY_NAME
from gsplat_edu.train.part import Part

SIDE = 240
"""Longest side of the photos of a pilot, px."""

OUT_OF_TIME = "short trainings would take more than a quarter of the time that is left, so none is judged"
"""Why a time limit left no choice."""


def chosen_by_pilots(
    part: Part,
    options: RunOptions,
    reader: CaptureReader,
    progress: Callable[[int], None] = lambda total: None,
    asked: str = "",
    is_over: Callable[[int, int], bool] = lambda done, planned: False,
) -> Tried:
    """Choose the setting `Part.tried` for a run by pilots, or judge the value that the user gave.

    Args:
        part: The part.
        options: Options of the run.
        reader: The run's capture.
        progress: See `gsplat_edu.parts.bench.Bench`.
        asked: The value that the user gave; "" chooses.
        is_over: See `gsplat_edu.parts.bench.Bench`. If it returns true, no pilot is judged, and what the user did not
            ask for has its default.

    Returns:
        What to train with, and why.

    Raises:
        ArgumentError: the capture has no training photos, or the backend cannot learn what was asked for.
        DatasetError: the capture or one of its photos cannot be read.
    """
    otherwise = asked or BY_NAME[part.tried].default
    if is_over(0, 0):
        return Tried(otherwise, OUT_OF_TIME)
    size = options.data_settings.resolution
    small = SIDE if size is None or not 32 <= size <= SIDE else size
    settings = as_trained(replace(options.data_settings, resolution=small), options.config)
    dataset = Dataset.of(reader, settings, points=options.points)
    if why := _why_not(dataset):
        return Tried(otherwise, why)
    dataset.preload()
    bench = Bench(
        options.config,
        dataset,
        reader.capture,
        options.data_settings.lens,
        load_backend(options.backend),
        lambda config: replace(options, config=config).renderer,
        progress,
        is_over,
    )
    try:
        tried: Tried = part.try_out(asked, bench)
    except OutOfTimeError:
        return Tried(otherwise, OUT_OF_TIME)
    return tried


def _why_not(dataset: Dataset) -> str:
    """Say as a clause why no pilot can be judged; "" if one can."""
    if not dataset.test:
        return "no photos are held out to judge by"
    for view in dataset.test:
        if scored_halves(view.read().mask, view.camera.H, view.camera.W) is not None:
            return ""
    return "no pixel of the held-out photos counts"

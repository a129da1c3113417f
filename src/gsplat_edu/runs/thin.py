"""How long a training on few photos may be before it overfits: short trials on most photos, judged by the others.

Many scenes fit a handful of photos, and a long training finds a wrong one, especially with inaccurate poses. The
held-out test photos take no part.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.evaluate.metrics import ImageScore, score_views
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.dataset import as_trained
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import TrainConfig, recipe
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Trainer

FEWEST, MANY = 4, 30
"""Captures of at least `FEWEST` training photos and fewer than `MANY` are tried."""

HOLD_OUT = 4
"""Every fourth training photo judges."""

SIDE = 240
"""Longest side of the photos of a trial, px."""

LENGTHS = (100, 200, 400, 800)
"""Iterations of the trials, in this order."""

OVERFIT_LOSS = 0.45
"""Stop once a trial scores this much below the best shorter one, dB. If longer trainings are better, trials fluctuate
by 0.3 dB."""


@dataclass(frozen=True)
class ThinTrial:
    """The result of the trials.

    Args:
        longest: Iterations after which a training gets worse; None if none of the trials was too long.
        scores: PSNR of the judging photos by iterations, dB.
        judges: Number of judging photos.
        cut: Whether they were ended before their time.
    """

    longest: int | None
    scores: dict[int, float]
    judges: int
    cut: bool = False

    def __str__(self) -> str:
        """Return why the training ends early; empty if it does not."""
        if self.longest is None:
            return ""
        last = max(self.scores)
        return (
            f"longer trainings make photos worse that they have not seen: {self.judges} training photos, held out for a"
            f" trial, score {self.scores[self.longest]:.1f} dB after {self.longest} iterations and"
            f" {self.scores[last]:.1f} dB after {last}; take more photos, or check the poses"
        )


def needs_trial(views: int) -> bool:
    """Return whether a capture with this number of training views needs trials."""
    return FEWEST <= views < MANY


def try_lengths(
    options: RunOptions,
    reader: CaptureReader,
    progress: Callable[[], None] = lambda: None,
    is_over: Callable[[], bool] = lambda: False,
) -> ThinTrial:
    """Train on most of the training photos for increasing numbers of iterations, until the others get worse.

    Args:
        options: Options of the run.
        reader: The run's capture, of which `needs_trial`.
        progress: Called after every iteration.
        is_over: Called after every iteration; if it returns true, only the trials that are finished count.

    Raises:
        DatasetError: the capture or one of its photos cannot be read.
    """
    size = options.data_settings.resolution
    small = SIDE if size is None or not 32 <= size <= SIDE else size
    settings = as_trained(
        dataclasses.replace(options.data_settings, resolution=small), options.config.appearance
    )
    dataset = Dataset.of(reader, settings, points=options.points)
    judges = dataset.train[HOLD_OUT // 2 :: HOLD_OUT]
    kept = tuple(view for i, view in enumerate(dataset.train) if i % HOLD_OUT != HOLD_OUT // 2)
    scores: dict[int, float] = {}
    cut = False
    for length in LENGTHS:
        config = _config(options.config, length)
        trainer = training(config, dataclasses.replace(dataset, train=kept), load_backend(options.backend))

        def step(trainer: Trainer, event: Event) -> None:
            if isinstance(event, StepEvent):
                progress()

        trainer.run(is_over, [step])
        if cut := trainer.iteration < length:
            break
        renderer = dataclasses.replace(options, config=config).renderer
        found = score_views(trainer.gaussians, judges, renderer, config.background)
        if not found:
            return ThinTrial(None, {}, 0)
        scores[length] = _mean(found, config.appearance != "none")
        if scores[length] < max(scores.values()) - OVERFIT_LOSS:
            break
    if not scores:
        return ThinTrial(None, {}, len(judges), cut)
    best = max(scores, key=lambda length: scores[length])
    fell = scores[max(scores)] < scores[best] - OVERFIT_LOSS
    return ThinTrial(best if fell else None, scores, len(judges), cut)


def _mean(scores: list[ImageScore], fitted: bool) -> float:
    """Return the mean PSNR, dB, after a fit of the exposure if the run corrects exposures."""
    values = [
        score.psnr if not fitted or score.psnr_fitted is None else score.psnr_fitted for score in scores
    ]
    return math.fsum(values) / len(values)


def _config(config: TrainConfig, iterations: int) -> TrainConfig:
    """Return the configuration of a trial: the recipe fast with the run's settings that change the image."""
    return recipe(
        iterations,
        strategy="fast",
        refine=config.refine,
        appearance=config.appearance,
        outside_masks=config.outside_masks,
        background=config.background,
        jacobian_limit=config.jacobian_limit,
        antialiased=config.antialiased,
        sh_degree=config.sh_degree,
        seed=config.seed,
    )

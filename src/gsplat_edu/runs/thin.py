"""How long a training on few photos may be before it overfits: short trials on most photos, judged by the others.

Many scenes fit a handful of photos, and a long training finds a wrong one, especially with inaccurate poses. PSNR tells
that, but is a poor judge of the best length then: with poses that are wrong by some pixels it prefers a blur to details
that are out of place. So `psnr_shifted` chooses the length. The held-out test photos take no part.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.evaluate.metrics import ImageScore, at_exposure_of, score_views
from gsplat_edu.evaluate.shifted import psnr_shifted
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.dataset import as_trained
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import planned_cap, training
from gsplat_edu.train.config import TrainConfig, short_config
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.length import usual_iterations
from gsplat_edu.train.trainer import Trainer

FEWEST, MANY = 4, 30
"""Captures of at least `FEWEST` training photos and fewer than `MANY` are tried."""

HOLD_OUT = 4
"""Every fourth training photo judges."""

SIDE = 240
"""Longest side of the photos of a trial, px."""

Picture = UInt8[np.ndarray, "H W 3"]
"""A render or a photo."""

LENGTHS = (100, 200, 400, 800)
"""Iterations of the trials, in this order."""

OVERFIT_LOSS = 0.45
"""A training is too long if its PSNR is this much below that of the best shorter one, dB. If longer trainings are
better, trials fluctuate by 0.3 dB."""


def usual_size(config: TrainConfig, dataset: Dataset) -> dict[str, int]:
    """Return the "iterations" that a recipe takes for a capture by itself, and for fast the "gaussians".

    Few photos may end it at the longest trial already.

    Args:
        config: The recipe.
        dataset: The capture.
    """
    views = len(dataset.train)
    length = usual_iterations(config.strategy, views)
    if config.strategy != "fast":
        return {"iterations": length}
    if FEWEST <= views < MANY:
        length = min(length, LENGTHS[-1])
    return {"iterations": length, "gaussians": planned_cap(dataset)}


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
        best = _best(self.scores)
        worst = min(_longer(self.scores, best), key=lambda length: self.scores[length])
        sharp = f"; {self.longest} show most detail, some pixels out of place" if self.longest != best else ""
        return (
            f"longer trainings make photos worse that they have not seen: {self.judges} training photos, held out for a"
            f" trial, score {self.scores[best]:.1f} dB after {best} iterations and"
            f" {self.scores[worst]:.1f} dB after {worst}{sharp}; take more photos, or check the poses"
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
    """Train on most of the training photos for increasing numbers of iterations, and score the others.

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
    settings = as_trained(dataclasses.replace(options.data_settings, resolution=small), options.config)
    dataset = Dataset.of(reader, settings, points=options.points)
    judges = dataset.train[HOLD_OUT // 2 :: HOLD_OUT]
    kept = tuple(view for i, view in enumerate(dataset.train) if i % HOLD_OUT != HOLD_OUT // 2)
    scores: dict[int, float] = {}
    shifted: dict[int, float] = {}
    cut = False
    for length in LENGTHS:
        config = short_config(options.config, length)
        trainer = training(config, dataclasses.replace(dataset, train=kept), load_backend(options.backend))

        def step(trainer: Trainer, event: Event) -> None:
            if isinstance(event, StepEvent):
                progress()

        trainer.run(is_over, [step])
        if cut := trainer.iteration < length:
            break
        found = _scored(trainer.gaussians, judges, dataclasses.replace(options, config=config))
        if found is None:
            return ThinTrial(None, {}, 0)
        scores[length], shifted[length] = found
    return ThinTrial(longest_of(scores, shifted), scores, len(judges), cut)


def longest_of(scores: dict[int, float], shifted: dict[int, float]) -> int | None:
    """Return the number of iterations after which a training gets worse; None if more are no worse.

    Args:
        scores: PSNR by iterations, dB: tells whether a training can be too long.
        shifted: `psnr_shifted` by the same iterations, dB: best at the longest that is not.
    """
    if not scores:
        return None
    best = _best(scores)
    fell = any(scores[length] < scores[best] - OVERFIT_LOSS for length in _longer(scores, best))
    return _best(shifted) if fell else None


def _best(scores: dict[int, float]) -> int:
    """Return the number of iterations with the highest score; the fewest of equal ones."""
    return max(sorted(scores), key=lambda length: scores[length])


def _longer(scores: dict[int, float], length: int) -> list[int]:
    """Return the numbers of iterations above another."""
    return [other for other in scores if other > length]


def _scored(gaussians: Gaussians, judges: Sequence[View], options: RunOptions) -> tuple[float, float] | None:
    """Return the mean PSNR and shifted PSNR, dB, with fitted exposures if the run has them; None without pixels."""
    fitted = options.config.corrects_colors
    shifted = []

    def compare(view: View, score: ImageScore, image: Picture, truth: Picture) -> None:
        mask = view.read().mask
        shown = torch.from_numpy(image / 255.0)
        shifted.append(psnr_shifted(at_exposure_of(truth, shown, mask) if fitted else shown, truth, mask))

    scores = score_views(gaussians, judges, options.renderer, options.config.background, compare)
    if not scores:
        return None
    values = [
        score.psnr if not fitted or score.psnr_fitted is None else score.psnr_fitted for score in scores
    ]
    return math.fsum(values) / len(values), math.fsum(shifted) / len(shifted)

"""Short trainings that decide whether the cameras of a capture should be refined: `--refine auto`.

A small scene is trained on small photos three times: without refinement, with poses, and with poses and intrinsics.
Each is judged by the held-out photos at aligned poses (`gsplat_edu.evaluate.alignment`). More is refined only if that
helps clearly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.evaluate.alignment import aligned_psnr, mean_aligned_psnr
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.dataset import as_trained
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.refined import with_refined_cameras
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import TrainConfig, recipe
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.poses import refinement_of
from gsplat_edu.train.trainer import Trainer

SIDE = 240
"""Longest side of the photos of a pilot, px."""

PILOT_STEPS, PILOT_CAP = 600, 10_000
"""Length and cap of a pilot."""

LEAST_GAIN = 0.3
"""Refine more only if it gains at least this, dB. Pilots of captures with correct cameras differed by less
(benchmarks/archive/RESULTS-2026-11.md)."""

ORDER = ("none", "poses", "both")


def refinement_for(
    options: RunOptions, reader: CaptureReader, progress: Callable[[], None] = lambda: None
) -> tuple[str, str]:
    """Choose `--refine` for a run by pilots.

    Args:
        options: Options of the run; its strategy does not matter, since pilots use the recipe fast.
        reader: The run's capture.
        progress: Called after every iteration.

    Returns:
        What to refine, and why, as a clause.

    Raises:
        ArgumentError: the capture has no training photos.
        DatasetError: the capture or one of its photos cannot be read.
    """
    size = options.data_settings.resolution
    small = SIDE if size is None or not 32 <= size <= SIDE else size
    settings = as_trained(replace(options.data_settings, resolution=small), options.config.appearance)
    dataset = Dataset.of(reader, settings, points=options.points)
    if not dataset.test:
        return "none", "no photos are held out to judge by"
    dataset.preload()
    scores: dict[str, float] = {}
    for refine in ORDER:
        score = _pilot(dataset, options, refine, progress)
        if score is None:
            return "none", "no pixel of the held-out photos counts"
        scores[refine] = score
    return _choice(scores)


def _choice(scores: dict[str, float]) -> tuple[str, str]:
    """Return the smallest refinement that no other beats by `LEAST_GAIN`, and the scores as a clause."""
    best = max(scores.values())
    chosen = next(refine for refine in ORDER if scores[refine] > best - LEAST_GAIN)
    figures = ", ".join(f"{scores[refine]:.2f} dB with {refine}" for refine in ORDER)
    return chosen, f"short trainings score the held-out photos, poses aligned, at {figures}"


def _pilot(dataset: Dataset, options: RunOptions, refine: str, progress: Callable[[], None]) -> float | None:
    """Train a pilot and return its score, dB; None if no pixel counts."""
    config = _config(options.config, refine)
    trainer = training(config, dataset, load_backend(options.backend))
    refinement = refinement_of(trainer.view_model)

    def step(trainer: Trainer, event: Event) -> None:
        if isinstance(event, StepEvent):
            progress()

    trainer.run(callbacks=[step])
    shown = dataset if refinement is None else with_refined_cameras(refinement, dataset)
    renderer = replace(options, config=config).renderer
    colors = config.appearance != "none"
    scores = [
        aligned_psnr(trainer.gaussians, view, renderer, config.background, trainer.extent, colors=colors)
        for view in shown.test
    ]
    return mean_aligned_psnr(scores)


def _config(config: TrainConfig, refine: str) -> TrainConfig:
    cap = min(config.max_gaussians or PILOT_CAP, PILOT_CAP)
    return recipe(
        PILOT_STEPS,
        strategy="fast",
        max_gaussians=cap,
        refine=refine,
        appearance=config.appearance,
        background=config.background,
        jacobian_limit=config.jacobian_limit,
        antialiased=config.antialiased,
        seed=config.seed,
    )

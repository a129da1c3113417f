"""A trained run as the doctor and the parts of its training judge it: the scene, its residuals, and its length."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.evaluate.verdict import Cause, Measured, Verdict, causes_of, judged
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.residuals import Residual
from gsplat_edu.train.config import RECIPE_ITERATIONS
from gsplat_edu.train.length import QUALITIES, planned_iterations, usual_iterations

UNEXPLAINED = 3.0
"""Warn about a view whose PSNR is this far below the median of its split, dB: 3 dB is twice the squared error."""

UNEXPLAINED_SPREAD = 3.0
"""It must also be this many sigma below the median, with sigma from the median absolute deviation."""

RISING = 0.1
"""Advise longer training if the test views' PSNR rose by at least this in the last quarter of the run, dB."""

FALLING = 0.97
"""The loss is still falling if its mean over the last tenth of the iterations is below this times its mean between
65 % and 75 % of them. Used if no views were held out."""

FAINT = 0.02
"""Splats below this opacity are hardly visible: they change a white 8-bit pixel by five levels."""

SPREAD_TO_NORMAL = 1.4826
"""Standard deviation of a normal distribution divided by its median absolute deviation."""


@dataclass(frozen=True, eq=False)
class Trained:
    """A run's scene and its residuals.

    Args:
        path: The run's folder.
        gaussians: The scene.
        extent: Extent of the camera positions, world units (`scene_extent`).
        train: Residuals of the training views.
        test: Residuals of the held-out views.
        reached: Completed iterations.
        planned: Planned iterations; None if the run does not record them.
        log: Entries of the run's log.jsonl.
        capture: The capture it was trained on; None if unknown.
        options: Further training options to repeat in an advised longer run, as command-line words.
        strategy: The run's recipe.
        measured: What the run's files tell; None if there is only what the residuals tell.
        views: The training views.
        features: Renders features of the scene (`gsplat_edu.render.api.render`); None to compare no photos.
        settings: The run's render settings.
        survey: Surveys the capture, which reads all photos and may raise a `DatasetError`; None if that is unwanted.
    """

    path: Path
    gaussians: Gaussians
    extent: float
    train: Sequence[Residual]
    test: Sequence[Residual]
    reached: int
    planned: int | None
    log: Sequence[Mapping[str, Any]] = ()
    capture: Path | None = None
    options: tuple[str, ...] = ()
    strategy: str = "adc"
    measured: Measured | None = None
    views: Sequence[View] = ()
    features: Callable[..., RenderOutput] | None = None
    settings: RenderSettings = RenderSettings()  # noqa: RUF009 - it is frozen
    survey: Callable[[], Survey] | None = None

    @cached_property
    def causes(self) -> dict[str, Cause]:
        """What is measured to be wrong, by the names of the findings, in their order."""
        return {cause.name: cause for cause in causes_of(self._scored)}

    @property
    def verdict(self) -> Verdict:
        """The verdict, as the report and the studio show it."""
        return judged(self.measured or self._scored)

    @property
    def _scored(self) -> Measured:
        """What is measured; the residuals give the scores of a run that was not evaluated."""
        known = self.measured or Measured(iterations=self.reached)
        if known.test is not None or known.train is not None:
            return known
        test, train = (mean_psnr(views) if views else None for views in (self.test, self.train))
        return replace(known, test=test, train=train, photos=len(self.train) + len(self.test))

    @property
    def usual(self) -> int:
        """The default number of iterations of the run's recipe."""
        return usual_iterations(self.strategy, len(self.train))

    @property
    def longest(self) -> int:
        """Iterations of the longest run that is advised."""
        if self.strategy != "fast":
            return RECIPE_ITERATIONS
        return planned_iterations(max(QUALITIES, key=lambda name: QUALITIES[name]), max(len(self.train), 1))

    @property
    def next_length(self) -> int:
        """Iterations of the longer run that is advised: those of the recipe first, then those of its best quality."""
        return self.usual if self.reached < self.usual else self.longest

    @property
    def longer(self) -> tuple[tuple[str, str], ...]:
        """Options of the longer run that is advised."""
        return (("iterations", str(self.next_length)),)

    @property
    def rising(self) -> bool | None:
        """Whether the scene was still improving when training ended; None if the log cannot tell.

        It cannot tell for the recipe fast: its rates fall until the end, which raises the PSNR of any run.
        """
        if self.strategy == "fast":
            return None
        scores = logged(self.log, "psnr", self.reached)
        if self.test:
            scores = [pair for pair in scores if pair[0] < self.reached] + [
                (self.reached, mean_psnr(self.test))
            ]
        earlier = [value for iteration, value in scores if iteration <= 0.75 * self.reached]
        if earlier and self.test:
            return scores[-1][1] - max(earlier[-2:]) >= RISING
        losses = logged(self.log, "loss", self.reached)
        last, before = (
            [value for iteration, value in losses if low * self.reached < iteration <= high * self.reached]
            for low, high in ((0.9, 1.0), (0.65, 0.75))
        )
        return float(np.mean(last)) < FALLING * float(np.mean(before)) if last and before else None


def logged(log: Sequence[Mapping[str, Any]], key: str, reached: int) -> list[tuple[int, float]]:
    """Return (iteration, value) of the log entries up to an iteration that have both, in order."""
    pairs = ((line.get("iteration"), line.get(key)) for line in log)
    return sorted(
        (i, float(v)) for i, v in pairs if isinstance(i, int) and i <= reached and isinstance(v, int | float)
    )


def mean_psnr(views: Sequence[Residual]) -> float:
    """Return the mean PSNR of at least one view, dB."""
    return float(np.mean([view.psnr for view in views]))


def far_below(views: Sequence[Residual]) -> list[Residual]:
    """Return the views far below the median PSNR, by a measure that is robust to a few outliers."""
    if len(views) < 4:
        return []
    values = np.array([view.psnr for view in views])
    median = float(np.median(values))
    spread = SPREAD_TO_NORMAL * float(np.median(np.abs(values - median)))
    limit = median - max(UNEXPLAINED, UNEXPLAINED_SPREAD * spread)
    return [view for view in views if view.psnr < limit]

"""Short trainings on one small dataset, by which parts choose a setting: `gsplat_edu.train.part.Part.try_out`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gsplat_edu.data.capture import Capture
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.evaluate.alignment import TensorRenderer, aligned_psnr
from gsplat_edu.render.backend import Backend
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import TrainConfig, short_config
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.part import parts
from gsplat_edu.train.trainer import Trainer

PILOT_STEPS, PILOT_CAP = 600, 10_000
"""Length and cap of a pilot."""


class OutOfTimeError(Exception):
    """The time for pilots is over."""


class Pilot(NamedTuple):
    """A training that is over."""

    gaussians: Gaussians
    began: Dataset
    shown: Dataset  # `began` with what parts learned of it
    extent: float


@dataclass(eq=False)
class Bench:
    """Trains and scores pilots.

    Args:
        config: The run's configuration; its strategy does not matter, since pilots use the recipe fast.
        dataset: The capture with small photos.
        capture: The capture as it was read.
        lens: The run's `gsplat_edu.data.settings.DataSettings.lens`.
        backend: The kernels.
        renderer: Returns what renders a scene with the settings of a configuration.
        progress: Called after every iteration with the number of iterations of all pilots, as far as it is known.
        is_over: Called with the iterations done and those of all pilots, as far as they are known; says whether the
            time is over.
        planned: Number of pilots, as far as it is known.
    """

    config: TrainConfig
    dataset: Dataset
    capture: Capture
    lens: str
    backend: Backend
    renderer: Callable[[TrainConfig], TensorRenderer]
    progress: Callable[[int], None]
    is_over: Callable[[int, int], bool]
    planned: int = 0
    _trainings: int = 0
    _steps: int = 0

    def train(self, dataset: Dataset, **changes: Any) -> Pilot:  # noqa: ANN401
        """Train a pilot.

        Args:
            dataset: The capture, perhaps with other cameras.
            changes: Settings that differ from the run's.

        Raises:
            OutOfTimeError: the time is over.
        """
        trainer = training(pilot_config(self.config, **changes), dataset, self.backend)
        self._trainings += 1
        total = max(self.planned, self._trainings) * PILOT_STEPS

        def step(trainer: Trainer, event: Event) -> None:
            if isinstance(event, StepEvent):
                self._steps += 1
                self.progress(total)
                self._check_time(total)

        trainer.run(callbacks=[step])
        shown = dataset
        for part in parts().values():
            shown = part.learned(trainer, shown)
        return Pilot(trainer.gaussians, dataset, shown, trainer.extent)

    def score(self, pilot: Pilot, *, moving: bool = False) -> float:
        """Return the mean PSNR of the held-out photos at aligned poses, dB; with `moving` at aligned motions too.

        Raises:
            OutOfTimeError: the time is over.
        """
        config = pilot_config(self.config)  # renders are alike for all
        renderer, colors, scores = self.renderer(config), config.corrects_colors, []
        for view in pilot.shown.test:
            self._check_time(self._steps)
            psnr = aligned_psnr(
                pilot.gaussians, view, renderer, config.background, pilot.extent, colors=colors, moving=moving
            )
            scores.append(psnr)
        return float(np.mean([score for score in scores if score is not None]))

    def _check_time(self, total: int) -> None:
        if self.is_over(self._steps, total):
            raise OutOfTimeError


def pilot_config(config: TrainConfig, **changes: Any) -> TrainConfig:  # noqa: ANN401
    """Return the configuration of a pilot: the recipe fast with the run's settings that change the image.

    Args:
        config: The run's configuration.
        changes: What the pilot tries.
    """
    cap = min(config.max_gaussians or PILOT_CAP, PILOT_CAP)
    return short_config(config, PILOT_STEPS, **{"max_gaussians": cap, **changes})

"""The training loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gsplat_edu.camera import Camera
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.losses import l1
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.base import DensityStrategy
from gsplat_edu.train.events import DensifyEvent, StepEvent
from gsplat_edu.train.optimizer import Adam
from gsplat_edu.views import View

Renderer = Callable[[Gaussians, Camera], RenderOutput]
"""Renders Gaussians from a camera, differentiably. Which backend does it is not the trainer's business."""

Callback = Callable[["Trainer", StepEvent | DensifyEvent], None]
"""Is told of every step and every densification, with the trainer as it stands after it."""


@dataclass(frozen=True)
class TrainResult:
    """A finished run.

    Args:
        losses: Loss of every iteration.
        counts: Gaussians rendered in every iteration.
        seconds: Wall time of the loop, callbacks included.
    """

    losses: list[float]
    counts: list[int]
    seconds: float


class Trainer:
    """Moves Gaussians until they look like the views.

    Each iteration draws a view, renders it, takes a step of Adam down the L1 loss and lets the density
    strategy change the Gaussians.

    Args:
        gaussians: Where to start; not changed.
        views: What to learn from, at least one.
        config: Budget, rates and seed.
        render: The renderer.
        density: The density strategy; None keeps the number of Gaussians.
        callbacks: Told of every step and every densification, in this order.

    Raises:
        ArgumentError: there are no views, or no Gaussians.

    Attributes:
        gaussians: The Gaussians as they stand.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        config: TrainConfig,
        *,
        render: Renderer,
        density: DensityStrategy | None = None,
        callbacks: Sequence[Callback] = (),
    ) -> None:
        if not views:
            raise ArgumentError("views: is empty; give at least one view to learn from")
        if not len(gaussians):
            raise ArgumentError("gaussians: is empty; give at least one Gaussian to start from")
        self.gaussians = gaussians.trainable()
        self.config, self.density = config, density
        self._render, self._callbacks = render, tuple(callbacks)
        self._cameras = [view.camera for view in views]
        self._targets = [torch.tensor(view.image, dtype=gaussians.means.dtype) for view in views]
        self._optimizer = Adam(self.gaussians, config.learning_rates)
        self._view_order = np.random.default_rng(config.seed)

    def run(self) -> TrainResult:
        """Take all the iterations of the budget. A trainer runs once."""
        losses, counts = [], []
        start = time.perf_counter()
        for iteration in range(self.config.iterations):
            step = self._step(iteration)
            losses.append(step.loss)
            counts.append(step.num_gaussians)
            self._tell(step)
            if self.density is not None:
                changed = self.density.update(iteration, self.gaussians, self._optimizer)
                if changed is not None:
                    self.gaussians, event = changed
                    self._tell(event)
        return TrainResult(losses, counts, time.perf_counter() - start)

    def _step(self, iteration: int) -> StepEvent:
        view = int(self._view_order.integers(len(self._cameras)))
        output = self._render(self.gaussians, self._cameras[view])
        loss = l1(output.image, self._targets[view])
        loss.backward()  # type: ignore[no-untyped-call]
        if self.density is not None:
            self.density.observe(output)
        self._optimizer.step(self.gaussians)
        return StepEvent(iteration, float(loss.detach()), len(self.gaussians))

    def _tell(self, event: StepEvent | DensifyEvent) -> None:
        for callback in self._callbacks:
            callback(self, event)

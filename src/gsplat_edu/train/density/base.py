"""The interface between the trainer and a density strategy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from gsplat_edu.ops.noise import NoiseNumbers
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.events import Change
from gsplat_edu.train.optimizer import Adam

State = tuple[dict[str, Tensor], dict[str, Any]]
"""The state in a checkpoint: tensors by name, and values that JSON can represent."""


@runtime_checkable
class DensityStrategy(Protocol):
    """Observes every step and periodically changes the Gaussians.

    The trainer calls `observe` and `update` with torch on one thread, so that their results do not depend on the
    number of threads.

    Set `observes_renders_only` to true if `observe` reads only its `output`. The Gaussians may then move in the
    backward pass (`TensorStepper.fuses`), before `observe` and without `grad`. Processes that share a step exchange
    what such a strategy observes until its attribute `is_over` is true, which means that it ignores all further
    renders.
    """

    def observe(self, gaussians: Gaussians, output: RenderOutput) -> None:
        """Observe a render after its backward pass and before the optimiser steps; called for every view of a step."""
        ...

    def update(self, iteration: int, gaussians: Gaussians, optimizer: Adam) -> tuple[Gaussians, list[Change]]:
        """Change the Gaussians after a step, and the optimiser's moments with them.

        Args:
            iteration: The last image of the step, counted from 0; a step has `TrainConfig.batch` of them.
            gaussians: The Gaussians after the step.
            optimizer: The optimiser.

        Returns:
            The Gaussians, as leaves that collect gradients: the given ones, possibly changed in place, or new ones;
            and the changes, as events for the callbacks.
        """
        ...

    def state(self) -> State:
        """Return the state from which a run resumes with identical results."""
        ...

    def load_state(self, tensors: dict[str, Tensor], numbers: dict[str, Any], gaussians: Gaussians) -> None:
        """Restore what `state` returned.

        Args:
            tensors: The tensors, by name.
            numbers: The values that are not tensors.
            gaussians: The Gaussians that training resumes with.

        Raises:
            ArgumentError: the state does not fit these Gaussians; nothing has changed.
        """
        ...


@runtime_checkable
class FollowsDevice(DensityStrategy, Protocol):
    """A strategy for Gaussians that stay on a device: `update` is called only when it is due.

    The device collects the statistics in place of `observe`, unless `is_over`.
    """

    def is_due(self, iteration: int) -> bool:
        """Return whether `update` would read the Gaussians, or change them other than by noise."""
        ...

    def passed(self, iteration: int, rate: float) -> NoiseNumbers | None:
        """Do what else `update` does after a step at which it is not due.

        Args:
            iteration: As for `update`.
            rate: The learning rate of the means.

        Returns:
            The noise to add; None for none.
        """
        ...

    def observed(self) -> Mapping[str, Tensor]:
        """Return the statistics, (N,) each, by name: "norm_sums" and "times_visible", or none."""
        ...

    def absorb(self, statistics: Mapping[str, Tensor]) -> None:
        """Replace the statistics by those of a device, which went on from `observed`."""
        ...

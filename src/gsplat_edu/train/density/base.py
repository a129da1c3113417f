"""The interface between the trainer and a density strategy."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from torch import Tensor

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

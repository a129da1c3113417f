"""What the trainer asks of a density strategy."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from gsplat_edu.gaussians import Gaussians
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.train.events import Change
from gsplat_edu.train.optimizer import Adam

State = tuple[dict[str, Tensor], dict[str, Any]]
"""What a checkpoint keeps: tensors by name, and what JSON can hold."""


@runtime_checkable
class DensityStrategy(Protocol):
    """Watches every step and, now and then, changes the Gaussians.

    The trainer calls both methods with torch on one thread, so that their answer does not depend on how many
    there are.
    """

    def observe(self, gaussians: Gaussians, output: RenderOutput) -> None:
        """Look at a render whose backward has run, before the optimiser steps; a step shows every view it renders."""
        ...

    def update(self, iteration: int, gaussians: Gaussians, optimizer: Adam) -> tuple[Gaussians, list[Change]]:
        """Change the Gaussians after a step, and the optimiser's moments with them.

        Returns:
            The Gaussians, leaves that collect gradients, which may be those given, changed in place or not; and
            what was done, for those who listen.
        """
        ...

    def state(self) -> State:
        """Return what is needed to go on later as if nothing had happened."""
        ...

    def load_state(self, tensors: dict[str, Tensor], numbers: dict[str, Any], gaussians: Gaussians) -> None:
        """Restore what `state` returned.

        Args:
            tensors: The tensors, by name.
            numbers: The rest.
            gaussians: The Gaussians that training resumes with.

        Raises:
            ArgumentError: they are not what `state` returns for these Gaussians; nothing has changed.
        """
        ...

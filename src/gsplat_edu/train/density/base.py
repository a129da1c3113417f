"""What the trainer asks of a density strategy."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from gsplat_edu.gaussians import Gaussians
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.train.events import DensifyEvent
from gsplat_edu.train.optimizer import Adam


@runtime_checkable
class DensityStrategy(Protocol):
    """Watches every step and, now and then, changes the Gaussians."""

    def observe(self, output: RenderOutput) -> None:
        """Look at a render whose backward has run, before the optimiser steps."""
        ...

    def update(
        self, iteration: int, gaussians: Gaussians, optimizer: Adam
    ) -> tuple[Gaussians, DensifyEvent] | None:
        """Change the Gaussians after a step, and the optimiser's moments with them.

        Returns:
            The new Gaussians, leaves that collect gradients, and what was done; None where nothing is due.
        """
        ...

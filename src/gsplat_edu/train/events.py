"""What the trainer reports while it runs. Whoever listens (a log, a bar, a plot) is given the trainer too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True)
class StepEvent:
    """One step was taken.

    Args:
        iteration: Counted from 0.
        loss_tensor: () the objective's term "photo" before the step, where the Gaussians are.
        num_gaussians: Gaussians that were rendered.
        terms: () every term of the objective by name, likewise.
    """

    iteration: int
    loss_tensor: Tensor
    num_gaussians: int
    terms: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def loss(self) -> float:
        """How far the render was from the photo before the step. Reading it waits for a GPU to come to it."""
        return float(self.loss_tensor)


@dataclass(frozen=True)
class DensifyEvent:
    """Adaptive density control changed the Gaussians, after the step of the same iteration.

    Args:
        iteration: Counted from 0.
        num_cloned: Gaussians added as clones.
        num_split_children: Gaussians added as children of splits; their parents are gone.
        num_pruned: Gaussians removed for their opacity or size.
        num_gaussians: Gaussians afterwards.
    """

    iteration: int
    num_cloned: int
    num_split_children: int
    num_pruned: int
    num_gaussians: int


@dataclass(frozen=True)
class ResetEvent:
    """Opacities were lowered, after the step (and the densification) of the same iteration.

    Args:
        iteration: Counted from 0.
        opacity: What they were lowered to where they were above it.
    """

    iteration: int
    opacity: float


@dataclass(frozen=True)
class RelocateEvent:
    """MCMC moved dead Gaussians to living ones and added others, after the step of the same iteration.

    Args:
        iteration: Counted from 0.
        num_relocated: Gaussians too faint to be seen that were moved.
        num_added: Gaussians added.
        num_gaussians: Gaussians afterwards.
    """

    iteration: int
    num_relocated: int
    num_added: int
    num_gaussians: int


Change = DensifyEvent | ResetEvent | RelocateEvent
Event = StepEvent | Change

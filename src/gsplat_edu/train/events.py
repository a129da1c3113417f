"""What the trainer reports while it runs. Whoever listens (a log, a bar, a plot) is given the trainer too."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StepEvent:
    """One step was taken.

    Args:
        iteration: Counted from 0.
        loss: Loss of the view before the step.
        num_gaussians: Gaussians that were rendered.
    """

    iteration: int
    loss: float
    num_gaussians: int


@dataclass(frozen=True)
class DensifyEvent:
    """Density control changed the Gaussians, after the step of the same iteration.

    Args:
        iteration: Counted from 0.
        num_cloned: Gaussians added as clones, before the cap.
        num_split_children: Gaussians added as children of splits, before the cap.
        num_pruned: Gaussians removed for their opacity.
        num_gaussians: Gaussians after the cap.
    """

    iteration: int
    num_cloned: int
    num_split_children: int
    num_pruned: int
    num_gaussians: int

"""Density control of the fast recipe: a planned number of Gaussians, splits by score, no resets.

The number of Gaussians follows a plan from that of the start to the cap. Each time, the Gaussians of the highest score
are split along their longest axis, which leaves the image nearly unchanged. Until the cap is reached, Gaussians that
have become faint are removed, and the plan replaces them where the score is high.

Its settings are in `gsplat_edu.train.config`.

Chapter: 16_birth_and_death.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsplat_edu.base.constants import ALPHA_MIN
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.base import State
from gsplat_edu.train.density.surgery import long_axis_children, replace
from gsplat_edu.train.events import Change, DensifyEvent
from gsplat_edu.train.far import Shell
from gsplat_edu.train.optimizer import Adam
from gsplat_edu.train.saved import (
    check_entries,
    check_flag,
    check_statistics,
    check_whole,
)
from gsplat_edu.train.schedule import milestone, planned_counts

STATISTICS = ("norm_sums", "times_visible")
"""Statistics collected for each Gaussian since the last densification."""


class PlannedDensity:
    """Split the Gaussians that need it most, as many as the plan asks for; prune faint ones.

    score = mean over the views that show it of the gradient norm of the mean in the image

    Args:
        config: Window, interval and cap.
        gaussians: The start Gaussians.
        shell: Where far splats lie, whose number is limited; None if there are none.

    Raises:
        ArgumentError: there is no cap.
    """

    observes_renders_only = True

    def __init__(self, config: TrainConfig, gaussians: Gaussians, shell: Shell | None = None) -> None:
        if config.max_gaussians is None:
            raise ArgumentError(
                "max_gaussians: the strategy fast grows to a planned number and needs it, for example 100000"
            )
        self.config, self.cap, self.shell = config, config.max_gaussians, shell
        self.start_count, self.is_over = len(gaussians), False
        self._forget(gaussians)

    def observe(self, gaussians: Gaussians, output: RenderOutput) -> None:
        """Add this view's gradient norms to the sums of the Gaussians it shows."""
        if self.is_over:
            return
        norms = output.means2d_grad_norms()
        self.norm_sums.index_add_(0, output.visible, norms)
        self.times_visible.index_add_(0, output.visible, norms.new_ones(1).expand(len(norms)))

    @torch.no_grad()
    def update(self, iteration: int, gaussians: Gaussians, optimizer: Adam) -> tuple[Gaussians, list[Change]]:
        """Prune, and split up to the plan, when the schedule says so."""
        config = self.config
        self.passed(iteration)
        due = self._due(iteration)
        if due is None:
            return gaussians, []
        growing = due <= config.fast.stop
        # Nothing replaces faint Gaussians later. Those below ALPHA_MIN are never drawn, and get no gradient.
        least = config.min_opacity if growing else min(config.min_opacity, ALPHA_MIN)
        keep = gaussians.finite_rows() & (gaussians.opacities >= least)
        planned = int(planned_counts(config, self.start_count, self.cap, np.array([due]))[0])
        room = planned - int(keep.sum()) if growing else 0
        may = keep if self.shell is None else self.shell.within_quota(keep, self._score(), gaussians.means)
        split = self.highest(may, room)
        children = long_axis_children(gaussians.map(lambda tensor: tensor[split]))
        replaced = replace(gaussians, optimizer, keep & ~split, children)
        self._forget(replaced)
        counts = 2 * len(children[0]), int((~keep).sum())
        return replaced, [DensifyEvent(iteration, 0, *counts, num_gaussians=len(replaced))]

    def is_due(self, iteration: int) -> bool:
        """Return whether the schedule says to prune and split; see `FollowsDevice.is_due`."""
        return self._due(iteration) is not None

    def passed(self, iteration: int, rate: float = 0.0) -> None:
        """Note the iteration; see `FollowsDevice.passed`."""
        self.is_over = iteration >= self.config.fast.stop

    def observed(self) -> dict[str, Tensor]:
        """Return the statistics; see `FollowsDevice.observed`."""
        return {name: getattr(self, name) for name in STATISTICS}

    def absorb(self, statistics: Mapping[str, Tensor]) -> None:
        """Replace the statistics; see `FollowsDevice.absorb`."""
        for name in STATISTICS:
            setattr(self, name, statistics[name])

    def _due(self, iteration: int) -> int | None:
        due = milestone(iteration, self.config.densify_every, self.config.batch)
        return due if due is not None and due > self.config.densify_start else None

    def highest(self, keep: Bool[Tensor, " N"], count: int) -> Bool[Tensor, " N"]:
        """Select the `count` Gaussians of the highest positive score, of equal ones the first."""
        score = self._score()
        score = torch.where(keep & (score > 0), score, 0.0)  # NaN is not above 0
        order = torch.argsort(score, descending=True, stable=True)[: max(count, 0)]
        chosen = torch.zeros_like(keep)
        chosen[order] = score[order] > 0
        return chosen

    def _score(self) -> Float[Tensor, " N"]:
        return self.norm_sums / self.times_visible.clamp(min=1)

    def _forget(self, gaussians: Gaussians) -> None:
        self.norm_sums = torch.zeros_like(gaussians.logit_opacities, requires_grad=False)
        self.times_visible = torch.zeros_like(self.norm_sums)

    def state(self) -> State:
        """Return the statistics since the last densification, and the number at the start."""
        statistics = {name: getattr(self, name) for name in STATISTICS}
        return statistics, {"start_count": self.start_count, "is_over": self.is_over}

    def load_state(self, tensors: dict[str, Tensor], numbers: dict[str, Any], gaussians: Gaussians) -> None:
        """Restore what `state` returned; see `DensityStrategy.load_state`."""
        check_entries("density", tensors, STATISTICS)
        statistics = {name: tensors[name] for name in STATISTICS}
        check_statistics(statistics, gaussians.logit_opacities)
        given = check_entries("density", numbers, ("start_count", "is_over"))
        start_count = check_whole("density: start_count", given["start_count"], self.cap)
        self.is_over = check_flag("density: is_over", given["is_over"])
        self.start_count = start_count
        for name, tensor in statistics.items():
            setattr(self, name, tensor)

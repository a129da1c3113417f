"""Adaptive density control: clone, split and prune by the gradient of the means in the image; reset opacities.

Its settings are in `gsplat_edu.train.config`.

Chapters: 09_train_in_3d, 16_birth_and_death.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.base import State
from gsplat_edu.train.density.surgery import replace, split_children
from gsplat_edu.train.events import Change, DensifyEvent, ResetEvent
from gsplat_edu.train.far import Shell
from gsplat_edu.train.optimizer import Adam
from gsplat_edu.train.saved import check_entries, check_flag, check_statistics, check_torch_generator
from gsplat_edu.train.schedule import milestone

STATISTICS = ("norm_sums", "times_visible")
"""Statistics collected for each Gaussian since the last densification."""


class AdaptiveDensityControl:
    """Clone small Gaussians, split large ones, prune faint ones.

    A large gradient of a Gaussian's image-plane mean shows that one Gaussian is not enough: a small one is cloned, and
    a large one is replaced by two smaller ones drawn from it. All opacities are lowered periodically; superfluous
    Gaussians then stay faint and are pruned.

    Args:
        config: Window, thresholds and cap.
        extent: Size of the scene, world units.
        generator: Source of the split children's positions.
        gaussians: The start Gaussians.
        shell: Where far splats lie, which may be large; None if there are none.

    Source: Kerbl et al. 2023, section 5.2.
    """

    observes_renders_only = True

    def __init__(
        self,
        config: TrainConfig,
        extent: float,
        generator: torch.Generator,
        gaussians: Gaussians,
        shell: Shell | None = None,
    ) -> None:
        self.config, self.extent, self.generator, self.shell = config, extent, generator, shell
        self.is_over = False
        self._forget(gaussians)

    def observe(self, gaussians: Gaussians, output: RenderOutput) -> None:
        """Add this view's gradient norms to the sums of the Gaussians it shows."""
        if self.is_over:
            return
        # Each index occurs once. `sums[visible] += norms` would take four times as long.
        visible, norms = output.visible, output.means2d_grad_norms()
        self.norm_sums.index_add_(0, visible, norms)
        self.times_visible.index_add_(0, visible, norms.new_ones(1).expand(len(visible)))

    @torch.no_grad()
    def update(self, iteration: int, gaussians: Gaussians, optimizer: Adam) -> tuple[Gaussians, list[Change]]:
        """Clone, split, prune and reset when the schedule says so."""
        events = list[Change]()
        self.passed(iteration)
        if self._densify_is_due(iteration):
            gaussians, densified = self._densify(iteration, gaussians, optimizer)
            events.append(densified)
        if self._reset_is_due(iteration):
            opacity = self.config.adc.reset_opacity
            ceiling = math.log(opacity / (1 - opacity))
            gaussians.logit_opacities.clamp_(max=ceiling)
            optimizer.forget("logit_opacities")
            events.append(ResetEvent(iteration, opacity))
        return gaussians, events

    def is_due(self, iteration: int) -> bool:
        """Return whether the schedule says to densify or to reset; see `FollowsDevice.is_due`."""
        return self._densify_is_due(iteration) or self._reset_is_due(iteration)

    def passed(self, iteration: int, rate: float = 0.0) -> None:
        """Note the iteration; see `FollowsDevice.passed`."""
        self.is_over = iteration + 1 >= self.config.adc.densify_stop

    def observed(self) -> dict[str, Tensor]:
        """Return the statistics; see `FollowsDevice.observed`."""
        return {name: getattr(self, name) for name in STATISTICS}

    def absorb(self, statistics: Mapping[str, Tensor]) -> None:
        """Replace the statistics; see `FollowsDevice.absorb`."""
        for name in STATISTICS:
            setattr(self, name, statistics[name])

    def _densify_is_due(self, iteration: int) -> bool:
        config = self.config
        due = milestone(iteration, config.densify_every, config.batch)
        return due is not None and config.densify_start < due < config.adc.densify_stop

    def _densify(
        self, iteration: int, gaussians: Gaussians, optimizer: Adam
    ) -> tuple[Gaussians, DensifyEvent]:
        config = self.config
        mean_norms = self.norm_sums / self.times_visible.clamp(min=1)
        size = gaussians.scales.amax(dim=-1)
        keep = gaussians.finite_rows() & (gaussians.opacities >= config.min_opacity)
        if config.adc.prune_scale and config.adc.reset_every and iteration > config.adc.reset_every:
            small = size <= config.adc.prune_scale * self.extent
            keep &= small if self.shell is None else small | self.shell.holds(gaussians.means)
        selected = keep & (mean_norms > config.adc.grad_threshold)
        if self.shell is not None:
            selected = self.shell.within_quota(selected, mean_norms, gaussians.means)
        if config.adc.over_cap == "strongest":
            selected = self._within_cap(mean_norms, selected, int(keep.sum()))
        large = size > config.adc.percent_dense * self.extent
        clone, split = selected & ~large, selected & large

        clones = gaussians.map(lambda tensor: tensor[clone])
        parents = gaussians.map(lambda tensor: tensor[split])
        children = [split_children(parents, config.adc.split_shrink, self.generator) for _ in range(2)]
        replaced = replace(
            gaussians,
            optimizer,
            keep & ~split,
            [clones, *children],
            config.max_gaussians,
            in_space=config.adc.over_cap != "cut",
        )
        self._forget(replaced)
        counts = len(clones), 2 * len(parents), int((~keep).sum())
        return replaced, DensifyEvent(iteration, *counts, num_gaussians=len(replaced))

    def _within_cap(
        self, mean_norms: Tensor, selected: Bool[Tensor, " N"], num_kept: int
    ) -> Bool[Tensor, " N"]:
        """Select as many Gaussians as the cap allows, largest gradients first: a clone or a split adds one."""
        room = (
            len(mean_norms)
            if self.config.max_gaussians is None
            else max(self.config.max_gaussians - num_kept, 0)
        )
        candidates = torch.nonzero(selected)[:, 0]
        if len(candidates) <= room:
            return selected
        order = torch.argsort(mean_norms[candidates], descending=True, stable=True)
        chosen = torch.zeros_like(selected)
        chosen[candidates[order[:room]]] = True
        return chosen

    def _reset_is_due(self, iteration: int) -> bool:
        config, every = self.config, self.config.adc.reset_every
        if not every:
            return False
        dues = [milestone(iteration, every, config.batch)]
        if min(config.background) >= 1.0 and iteration - config.batch < config.densify_start <= iteration:
            dues.append(config.densify_start)
        return any(due is not None and 0 < due < config.adc.densify_stop for due in dues)

    def _forget(self, gaussians: Gaussians) -> None:
        self.norm_sums = torch.zeros_like(gaussians.logit_opacities, requires_grad=False)
        self.times_visible = torch.zeros_like(self.norm_sums)

    def state(self) -> State:
        """Return the statistics since the last densification, and the generator."""
        statistics = {name: getattr(self, name) for name in STATISTICS}
        return statistics | {"generator": self.generator.get_state()}, {"is_over": self.is_over}

    def load_state(self, tensors: dict[str, Tensor], numbers: dict[str, Any], gaussians: Gaussians) -> None:
        """Restore what `state` returned; see `DensityStrategy.load_state`."""
        check_entries("density", tensors, (*STATISTICS, "generator"))
        statistics = {name: tensors[name] for name in STATISTICS}
        check_statistics(statistics, gaussians.logit_opacities)
        check_torch_generator("density.generator", tensors["generator"], self.generator)
        is_over = check_flag("density: is_over", check_entries("density", numbers, ("is_over",))["is_over"])
        self.generator.set_state(tensors["generator"])
        for name, tensor in statistics.items():
            setattr(self, name, tensor)
        self.is_over = is_over

"""Adaptive density control: clone, split and prune by the gradient of the means in the image.

Its differences from the paper are listed in `gsplat_edu.train.config`.
"""

from __future__ import annotations

import torch

from gsplat_edu.gaussians import Gaussians
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.train.config import DensityConfig
from gsplat_edu.train.density.surgery import replace, split_children
from gsplat_edu.train.events import DensifyEvent
from gsplat_edu.train.optimizer import Adam


class AdaptiveDensityControl:
    """Clone the small, split the large, prune the faint.

    Where the loss pulls hard on a Gaussian's place in the image, one Gaussian is not enough: a small one is
    copied, a large one gives way to two smaller ones drawn from it.

    Args:
        config: Window, thresholds and cap.
        generator: Source of the split children's positions.
        gaussians: What training starts from.

    Source: Kerbl et al. 2023, section 5.2.
    """

    def __init__(self, config: DensityConfig, generator: torch.Generator, gaussians: Gaussians) -> None:
        self.config, self.generator = config, generator
        self._forget(gaussians)

    def observe(self, output: RenderOutput) -> None:
        """Add this view's gradient norms to those of the Gaussians it shows."""
        self.norm_sums[output.visible] += output.means2d_grad_norms()
        self.times_visible[output.visible] += 1

    @torch.no_grad()
    def update(
        self, iteration: int, gaussians: Gaussians, optimizer: Adam
    ) -> tuple[Gaussians, DensifyEvent] | None:
        """Clone, split and prune where the schedule has it."""
        config = self.config
        if not config.start <= iteration < config.stop or iteration % config.every:
            return None
        hot = self.norm_sums / self.times_visible.clamp(min=1) > config.grad_threshold
        large = gaussians.scales.amax(dim=-1) > config.percent_dense * config.extent
        keep = gaussians.opacities >= config.min_opacity
        clone, split = keep & hot & ~large, keep & hot & large

        clones = gaussians.map(lambda tensor: tensor[clone])
        parents = gaussians.map(lambda tensor: tensor[split])
        children = [split_children(parents, config.split_shrink, self.generator) for _ in range(2)]
        replaced = replace(gaussians, optimizer, keep & ~split, [clones, *children], config.max_gaussians)
        self._forget(replaced)
        event = DensifyEvent(
            iteration, len(clones), 2 * len(parents), int((~keep).sum()), num_gaussians=len(replaced)
        )
        return replaced, event

    def _forget(self, gaussians: Gaussians) -> None:
        self.norm_sums = torch.zeros_like(gaussians.logit_opacities, requires_grad=False)
        self.times_visible = torch.zeros_like(self.norm_sums)

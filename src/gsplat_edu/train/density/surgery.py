"""Add and remove Gaussians; the survivors keep their optimiser moments."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from gsplat_edu.gaussians import Gaussians, quat_to_R_t
from gsplat_edu.train.optimizer import Adam


@torch.no_grad()
def split_children(parents: Gaussians, shrink: float, generator: torch.Generator) -> Gaussians:
    """Draw one child per parent from the parent's own distribution, smaller than the parent.

    mean' = mean + R (scale * n), n ~ N(0, I);  scale' = scale / shrink

    Args:
        parents: N Gaussians.
        shrink: Divisor of the scales.
        generator: Source of n.

    Returns:
        N children.

    Source: Kerbl et al. 2023, section 5.2.
    """
    noise = torch.randn(len(parents), 3, generator=generator, dtype=parents.means.dtype).to(
        parents.means.device
    )
    offset = (quat_to_R_t(parents.quats) @ (parents.scales * noise)[..., None])[..., 0]
    changed = {"means": parents.means + offset, "log_scales": parents.log_scales - math.log(shrink)}
    return Gaussians(**(parents.tensors() | changed))


@torch.no_grad()
def replace(
    gaussians: Gaussians,
    optimizer: Adam,
    keep: Bool[Tensor, " N"],
    newborn: list[Gaussians],
    cap: int | None = None,
) -> Gaussians:
    """Keep some Gaussians, append others, and drop from the end those over the cap.

    Args:
        gaussians: The N Gaussians.
        optimizer: Its moments follow: survivors keep theirs, new Gaussians start from zero.
        keep: (N,) true for the survivors.
        newborn: Gaussians to append, in this order.
        cap: Largest number of Gaussians afterwards; None for no cap.

    Returns:
        The new Gaussians, leaves that collect gradients.
    """
    survivors: Int64[Tensor, " S"] = torch.nonzero(keep)[:cap, 0]
    parts = [gaussians.map(lambda tensor: tensor[survivors]), *newborn]
    replaced = Gaussians.concatenated(parts).map(lambda tensor: tensor[:cap].contiguous())
    optimizer.follow(survivors, len(replaced) - len(survivors))
    return replaced.map(lambda tensor: tensor.requires_grad_())

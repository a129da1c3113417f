"""Add, remove and sort Gaussians; the survivors keep their optimiser moments.

Chapter: 16_birth_and_death.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gsplat_edu.scene.gaussians import Gaussians, quat_to_R_t
from gsplat_edu.scene.morton import order_in_space
from gsplat_edu.train.optimizer import Adam, carry_state


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
def long_axis_children(parents: Gaussians) -> list[Gaussians]:
    """Replace every Gaussian by two along its longest axis that look like it together.

    mean' = mean +- s e / sqrt 2,   s' = s / sqrt 2,   o' = 1 - (1 - o)^(1 / sqrt 2)

    with e the longest axis and s its scale: the two have the parent's mean and variance, and for small o its mass.

    Args:
        parents: N Gaussians.

    Returns:
        N children on the positive side of the axis and N on the negative one.

    Source: the axis from Deng et al. 2025, "Improving Densification in 3D Gaussian Splatting"; the opacity from Brush.
    """
    rows = torch.arange(len(parents), device=parents.means.device)
    axis = parents.log_scales.argmax(dim=-1)
    offset = math.sqrt(0.5) * parents.scales[rows, axis, None] * quat_to_R_t(parents.quats)[rows, :, axis]
    log_scales = parents.log_scales.clone()
    log_scales[rows, axis] -= 0.5 * math.log(2)
    # log(1 - o') = log(1 - o) / sqrt 2, without cancellation for faint or nearly opaque parents
    log_rest = -math.sqrt(0.5) * torch.nn.functional.softplus(parents.logit_opacities)
    logits = torch.log(-torch.expm1(log_rest)) - log_rest
    changed = {"log_scales": log_scales, "logit_opacities": logits}
    return [
        Gaussians(**(parents.tensors() | changed | {"means": parents.means + sign * offset}))
        for sign in (1, -1)
    ]


@torch.no_grad()
def replace(
    gaussians: Gaussians,
    optimizer: Adam | torch.optim.Optimizer,
    keep: Bool[Tensor, " N"],
    newborn: list[Gaussians],
    cap: int | None = None,
    in_space: bool = True,
) -> Gaussians:
    """Keep some Gaussians, add others, drop those over the cap, and sort the rest along a Morton curve.

    A tile's Gaussians are neighbours in space. Near one another in memory, they are read faster.

    Args:
        gaussians: The N Gaussians.
        optimizer: Its moments follow: survivors keep theirs, new Gaussians start from zero. An optimiser of torch gets
            the new parameters, too; see `carry_state`.
        keep: (N,) true for the survivors.
        newborn: Gaussians to add; the last ones are the first to be dropped.
        cap: Largest number of Gaussians afterwards; None for no cap.
        in_space: Sort; otherwise survivors come first, then the new ones in their order.

    Returns:
        The new Gaussians, leaves that collect gradients.
    """
    everyone = [part.tensors() for part in (gaussians, *newborn)]
    survivors = torch.nonzero(keep)[:, 0]
    added = torch.arange(len(gaussians), sum(len(part["means"]) for part in everyone), device=keep.device)
    chosen: Int64[Tensor, " M"] = torch.cat([survivors, added])[:cap]
    if in_space:
        chosen = chosen[_order(torch.cat([part["means"] for part in everyone])[chosen])]
    replaced = {
        name: torch.cat([part[name] for part in everyone]).index_select(0, chosen) for name in everyone[0]
    }
    origins = torch.where(chosen < len(gaussians), chosen, -1)
    after = Gaussians(**replaced).map(lambda tensor: tensor.requires_grad_())
    if isinstance(optimizer, Adam):
        optimizer.follow(origins)
    else:
        carry_state(optimizer, gaussians, after, origins)
    return after


@torch.no_grad()
def sorted_in_space(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians sorted along a Morton curve through their means."""
    order = _order(gaussians.means)
    return gaussians.map(lambda tensor: tensor.index_select(0, order))


def _order(means: Float[Tensor, "N 3"]) -> Int64[Tensor, " N"]:
    return torch.from_numpy(order_in_space(means.numpy(force=True))).to(means.device)

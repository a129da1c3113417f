"""Terms that turn a cloud into a surface: normals that agree with the depth, and flat Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.ops.surface import normal_error
from gsplat_edu.train.far import Shell
from gsplat_edu.train.rendered import Needs, Rendered, Turns

NORMAL, FLAT = "normal", "flat"
"""Names of the terms."""


@dataclass(frozen=True)
class NormalTerm:
    """Makes the composited normals those of the mean depth: `gsplat_edu.ops.surface.normal_error`.

    Args:
        weight: Factor of the value, on the average of all steps.
        turns: The steps that compare them.
    """

    weight: float
    turns: Turns

    @property
    def needs(self) -> Needs:
        """Depth and normals, in its turns."""
        return Needs(normals=True, turns=self.turns)

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return weight every mean a (a - N . m).

        Raises:
            ArgumentError: the normals or the depth were not rendered.
        """
        if not self.turns.due(rendered.iteration):
            return rendered.output.image.new_zeros(())
        surface = rendered.surface
        if surface.normals is None or surface.depth is None:
            raise ArgumentError(
                "normal: needs the depth, and `facing_normals` composited as `output.features`"
            )
        camera, weight = rendered.camera or rendered.draw.view.camera, self.weight * self.turns.every
        return normal_error(surface.normals, surface.depth, surface.alpha, camera, weight)


@dataclass(frozen=True)
class FlatTerm:
    """Makes the visible Gaussians flat.

    Args:
        weight: Factor of the value, on the average of all steps.
        extent: Size of the scene, world units.
        turns: The steps that flatten.
        shell: Where far splats lie, which are left as they are; None if there are none.
    """

    weight: float
    extent: float
    turns: Turns
    shell: Shell | None = None

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return weight every mean_visible(smallest scale) / extent."""
        logs, visible = rendered.gaussians.log_scales, rendered.output.visible
        if not self.turns.due(rendered.iteration):
            return logs.new_zeros(())
        if self.shell is not None:
            far = self.shell.holds(rendered.gaussians.means.detach().index_select(0, visible))
            visible = visible[~far]
        weight = self.weight * self.turns.every / self.extent
        value: Tensor = _MeanSmallest.apply(logs, visible, weight)  # type: ignore[no-untyped-call]
        return value


@first_derivative_only("the mean smallest scale", "weight * log_scales.min(dim=1).values.exp().mean()")
class _MeanSmallest(torch.autograd.Function):
    """Compute weight mean(exp(min(l))) of some rows; on one thread, whose rounding does not depend on the others."""

    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, rows: Tensor, weight: float) -> Tensor:  # noqa: ANN401
        with one_thread():
            smallest, axis = log_scales.detach().index_select(0, rows).min(dim=1)
            scaled = torch.exp(smallest).mul_(weight / max(len(rows), 1))
            gradient = torch.zeros_like(log_scales)
            gradient[rows, axis] = scaled
            ctx.save_for_backward(gradient)
            return scaled.sum()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401
        (gradient,) = ctx.saved_tensors
        return gradient * grad, None, None

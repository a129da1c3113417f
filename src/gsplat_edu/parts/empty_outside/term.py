"""The term that keeps the scene empty outside of masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.buffers import reusable_tensor
from gsplat_edu.base.derivatives import chained, first_derivative_only
from gsplat_edu.base.threads import one_thread
from gsplat_edu.train.rendered import Needs, Rendered

OUTSIDE_WEIGHT = 0.3
"""Weight of the mean alpha outside the masks of an object. 0.1 leaves 1.4 times the alpha outside, 3 costs 1.3 dB
inside (benchmarks/RESULTS.md)."""


@dataclass(frozen=True)
class EmptyOutside:
    """Keeps the scene empty where the capture's masks exclude pixels, as around an object that they cut out.

    Args:
        weight: lambda_e.
    """

    weight: float
    needs: ClassVar[Needs] = Needs(outside=True)

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return weight sum_outside(1 - T) / (H W), with the transmittance T; 0 if the photo has no mask."""
        transmittance, outside = rendered.output.transmittance, rendered.target.outside
        if outside is None:
            return transmittance.new_zeros(())
        value: Tensor = _EmptyOutside.apply(transmittance, self.weight, outside)  # type: ignore[no-untyped-call]
        return value


@first_derivative_only("the alpha outside masks", "weight * (1 - transmittance)[outside].sum()")
class _EmptyOutside(torch.autograd.Function):
    """Compute weight sum_outside(1 - T) / (H W), with the gradient -weight / (H W) outside.

    The rounding of torch's sums depends on the number of threads, so one thread computes it.
    """

    @staticmethod
    def forward(ctx: Any, transmittance: Tensor, weight: float, outside: Tensor) -> Tensor:  # noqa: ANN401
        with one_thread():
            share = weight / max(transmittance.numel(), 1)
            gradient = reusable_tensor(transmittance.shape, transmittance).copy_(outside).mul_(-share)
            ctx.save_for_backward(gradient)
            return (transmittance * gradient).sum() - gradient.sum()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401
        (gradient,) = ctx.saved_tensors
        return chained(gradient, grad), None, None

"""One step of Adam for one tensor, natively or in torch; each backend uses one of them (`gsplat_edu.render.backends`).

m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g²
p -= rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

Source: Kingma and Ba 2015, algorithm 1.

Chapter: 12_the_backward_pass.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gsplat_edu.base.threads import native_threads, one_thread
from gsplat_edu.ops import kernels
from gsplat_edu.ops.moments import AdamNumbers

AdamKernel = Callable[[Tensor, Tensor, Tensor, Tensor, AdamNumbers], None]
"""Moves a parameter and its two moments in place, given the gradient and the numbers."""


@torch.no_grad()
def adam_natively(
    parameter: Tensor, first: Tensor, second: Tensor, gradient: Tensor, numbers: AdamNumbers
) -> None:
    """Move a parameter and its moments in one native pass, in place; the same bits on any number of threads.

    Args:
        parameter: The parameter; any shape, contiguous, float32 or float64 on the CPU.
        first: m, of its shape, dtype and device.
        second: v, likewise.
        gradient: g, of its shape.
        numbers: Rate, decays, eps and corrections.

    Raises:
        BackendUnavailableError: the native module is missing.
    """
    kernels.kernel("adam_f", parameter.dtype)(
        parameter=kernels.native_array(parameter),
        first=kernels.native_array(first),
        second=kernels.native_array(second),
        gradient=kernels.native_array(gradient.to(parameter.dtype).contiguous()),
        **numbers._asdict(),
        threads=native_threads(),
    )
    torch.autograd.graph.increment_version(parameter)  # so that autograd knows of the change


@torch.no_grad()
@one_thread()
def adam_in_torch(
    parameter: Tensor, first: Tensor, second: Tensor, gradient: Tensor, numbers: AdamNumbers
) -> None:
    """Move a parameter and its moments by torch's operations, in place; any device, dtype and strides."""
    rate, b1, b2, eps, correction1, correction2 = numbers
    first.mul_(b1).add_(gradient, alpha=1 - b1)
    second.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
    parameter -= rate * (first / correction1) / ((second / correction2).sqrt() + eps)

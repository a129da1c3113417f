"""One step of Adam for one tensor, by the kernel that takes it: the native one, Triton's, or torch.

Chapter: 12_the_backward_pass.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import torch
from torch import Tensor

from gsplat_edu import kernels
from gsplat_edu.moments import AdamNumbers

AdamKernel = Callable[[Tensor, Tensor, Tensor, Tensor, AdamNumbers], None]
"""Moves a parameter and its two moments in place, given the gradient and the numbers; see `adam_step`."""


@torch.no_grad()
def adam_step(
    parameter: Tensor, first: Tensor, second: Tensor, gradient: Tensor, numbers: AdamNumbers
) -> None:
    """Move a parameter and its moments, in place.

    m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g²
    p -= rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

    On the CPU this is one native pass, the same to the bit on any number of threads; on a GPU it is one Triton kernel.
    Torch steps where neither takes the tensor: without the native module, without Triton, or if the tensor is strided
    or of another dtype.

    Args:
        parameter: The parameter; any shape.
        first: m, of its shape, dtype and device.
        second: v, likewise.
        gradient: g, of its shape.
        numbers: Rate, decays, eps and corrections.

    Source: Kingma and Ba 2015, algorithm 1.
    """
    if _native_takes(parameter):
        _step_natively(parameter, first, second, gradient, numbers)
    elif _gpu_takes(parameter):
        from gsplat_edu.render.triton.adam import adam_triton

        with torch.cuda.device_of(parameter):  # type: ignore[no-untyped-call]
            adam_triton(parameter, first, second, gradient, tuple(numbers))
    else:
        _step_in_torch(parameter, first, second, gradient, numbers)


def _native_takes(parameter: Tensor) -> bool:
    here = (
        parameter.device.type == "cpu" and parameter.dtype in kernels.SUFFIXES and parameter.is_contiguous()
    )
    return here and kernels.REASON is None


def _gpu_takes(parameter: Tensor) -> bool:
    here = parameter.device.type == "cuda" and parameter.dtype == torch.float32 and parameter.is_contiguous()
    return here and importlib.util.find_spec("triton") is not None


def _step_natively(
    parameter: Tensor, first: Tensor, second: Tensor, gradient: Tensor, numbers: AdamNumbers
) -> None:
    kernels.kernel("adam_f", parameter.dtype)(
        parameter=kernels.native_array(parameter),
        first=kernels.native_array(first),
        second=kernels.native_array(second),
        gradient=kernels.native_array(gradient.to(parameter.dtype).contiguous()),
        **numbers._asdict(),
        threads=torch.get_num_threads(),
    )
    torch.autograd.graph.increment_version(parameter)  # so that autograd knows of the change


def _step_in_torch(
    parameter: Tensor, first: Tensor, second: Tensor, gradient: Tensor, numbers: AdamNumbers
) -> None:
    rate, b1, b2, eps, correction1, correction2 = numbers
    first.mul_(b1).add_(gradient, alpha=1 - b1)
    second.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
    parameter -= rate * (first / correction1) / ((second / correction2).sqrt() + eps)

"""Adam as a Triton kernel: one pass over a parameter and its moments."""

from __future__ import annotations

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import check_shape

BLOCK = tl.constexpr(1024)


@triton.jit
@no_type_check
def adam_kernel(parameter, m, v, gradient, count, numbers):
    """Update one block: m = b1 m + n1 g, v = b2 v + n2 g², p -= rate (m c1) / (sqrt(v c2) + eps)."""
    rate, b1, b2, n1, n2, eps, c1, c2 = numbers
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(
        0, BLOCK
    )  # 64 bits: sh_rest has 45 values per Gaussian
    here = i < count
    g = tl.load(gradient + i, mask=here, other=0.0)
    first = b1 * tl.load(m + i, mask=here, other=0.0) + n1 * g
    second = b2 * tl.load(v + i, mask=here, other=0.0) + n2 * g * g
    # Correctly rounded root and quotient instead of the fast ones: the pass is limited by memory anyway.
    step = tl.div_rn(rate * (first * c1), tl.sqrt_rn(second * c2) + eps)
    moved = tl.load(parameter + i, mask=here, other=0.0) - step
    tl.store(m + i, first, mask=here)
    tl.store(v + i, second, mask=here)
    tl.store(parameter + i, moved, mask=here)


@torch.no_grad()
def adam_triton(
    parameter: Float[Tensor, "..."],
    m: Float[Tensor, "..."],
    v: Float[Tensor, "..."],
    gradient: Float[Tensor, "..."],
    numbers: tuple[float, ...],
) -> None:
    """Update one parameter and its moments in place.

    m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g²
    p -= rate (m / correction1) / (sqrt(v / correction2) + eps)

    Args:
        parameter: The parameter, float32, contiguous; any shape.
        m: First moment, likewise.
        v: Second moment, likewise.
        gradient: The parameter's gradient.
        numbers: rate, b1, b2, eps, correction1 = 1 - b1^t, correction2 = 1 - b2^t.

    Raises:
        ShapeError: a moment or the gradient has another shape than the parameter.
        ArgumentError: the parameter or a moment is not float32 and contiguous.

    Source: Kingma and Ba 2015, algorithm 1.
    """
    for name, tensor in (("parameter", parameter), ("m", m), ("v", v)):
        if tensor.dtype != torch.float32 or not tensor.is_contiguous():
            kind = f"{tensor.dtype}{'' if tensor.is_contiguous() else ', not contiguous'}"
            raise ArgumentError(
                f"{name}: is {kind}, but must be float32 and contiguous to be updated in place"
            )
    for name, tensor in (("m", m), ("v", v), ("gradient", gradient)):
        check_shape(name, tensor.shape, parameter.shape, {})
    count = parameter.numel()
    if count:
        # As floats: Triton would compile a whole number into the kernel.
        rate, b1, b2, eps, correction1, correction2 = map(float, numbers)
        rounded_once = (rate, b1, b2, 1 - b1, 1 - b2, eps, 1 / correction1, 1 / correction2)
        g = gradient.to(torch.float32).contiguous()
        adam_kernel[(triton.cdiv(count, BLOCK.value),)](parameter, m, v, g, count, rounded_once)
        torch.autograd.graph.increment_version(parameter)  # informs autograd of the change

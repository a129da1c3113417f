"""Proofs of gradients by finite differences, in float64."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def weighted(outputs: Tensor | Sequence[Tensor]) -> Tensor:
    """Return the sum of all numbers of the outputs, each times a normal random weight, the same in every call."""
    draw = torch.Generator().manual_seed(57)
    together = torch.cat(
        [output.reshape(-1) for output in ([outputs] if isinstance(outputs, Tensor) else outputs)]
    )
    return torch.randn(together.shape, generator=draw, dtype=together.dtype) @ together


def proves_gradients(
    forward: Callable[..., Tensor | Sequence[Tensor]],
    inputs: Sequence[Tensor],
    atol: float = 1e-6,
    rtol: float = 1e-5,
) -> bool:
    """Compare the derivatives of `weighted(forward(*inputs))` by every number of the inputs with central differences.

    A wrong derivative of any output shows, unless errors of several outputs cancel with these weights. Running backward
    once instead of once for each pixel makes the proof hundreds of times cheaper.

    Args:
        forward: A function of float64 tensors, smooth within a step of 1e-6 around the inputs.
        inputs: The tensors; all of them get a gradient.
        atol: Allowed difference.
        rtol: Allowed difference, as a share of the derivative.
    """
    leaves = [tensor.detach().clone().requires_grad_() for tensor in inputs]
    return torch.autograd.gradcheck(
        lambda *given: weighted(forward(*given)), leaves, eps=1e-6, atol=atol, rtol=rtol
    )

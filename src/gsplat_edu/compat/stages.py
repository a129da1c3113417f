"""Stages of gsplat's interface whose torch operations run on one thread, forward and backward.

Autograd would run them backward on all threads. Sums would then have other last bits, and where several processes share
the cores, the threads of one wait for those of others at each operation. Native kernels keep their threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.threads import one_thread
from gsplat_edu.compat.screen import INSTEAD

Stage = Callable[..., Sequence[Tensor]]
"""Computes tensors from tensors."""


def stage(compute: Stage, *tensors: Tensor) -> tuple[Tensor, ...]:
    """Return what `compute` makes of tensors; torch computes and differentiates it on one thread.

    Args:
        compute: Its other inputs are constants for the gradient.
        tensors: Its arguments.
    """
    found: tuple[Tensor, ...] = _Stage.apply(compute, *tensors)  # type: ignore[no-untyped-call]
    return found


@first_derivative_only("gsplat's rasterization", INSTEAD)
class _Stage(torch.autograd.Function):
    """A graph inside the graph."""

    @staticmethod
    def forward(ctx: Any, compute: Stage, *tensors: Tensor) -> tuple[Tensor, ...]:  # noqa: ANN401
        with torch.enable_grad(), one_thread():
            inside = [tensor.detach().requires_grad_(tensor.requires_grad) for tensor in tensors]
            made = compute(*inside)
        ctx.graph = inside, made
        ctx.set_materialize_grads(False)
        out = tuple(tensor.detach() for tensor in made)
        ctx.mark_non_differentiable(*(a for a, b in zip(out, made, strict=True) if not b.requires_grad))
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        if ctx.graph is None:
            raise RuntimeError(
                "this image has been differentiated, and its graph is gone; pass retain_graph=True"
            )
        inside, made = ctx.graph
        keeps = torch._C._autograd._get_current_graph_task_keep_graph()
        ctx.graph = ctx.graph if keeps else None
        given = [(out, grad) for out, grad in zip(made, grads, strict=True) if grad is not None]
        wanted = [tensor for tensor in inside if tensor.requires_grad]
        with one_thread():
            found = torch.autograd.grad(
                [out for out, _ in given], wanted, [grad for _, grad in given], keeps, allow_unused=True
            )
        of = iter(found)
        return None, *(next(of) if tensor.requires_grad else None for tensor in inside)

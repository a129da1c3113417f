"""For functions whose gradient is computed by hand: its guard, since it has none itself, and the chain rule."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError

_P = ParamSpec("_P")
_T = TypeVar("_T")


def first_derivative_only(what: str, instead: str) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Guard the backward pass of a `torch.autograd.Function` against being differentiated.

    Autograd enables gradients in a backward pass exactly if that pass itself is to be differentiated (`create_graph`).
    torch's `once_differentiable` then raises only if the incoming gradient depends on an input, and leaves a second
    derivative of zero otherwise, as for the sum of an image; so this guard raises whenever a graph is asked for.

    Args:
        what: What has first derivatives only, for the message.
        instead: What has second ones.
    """

    def decorate(backward: Callable[_P, _T]) -> Callable[_P, _T]:
        @functools.wraps(backward)
        def guarded(*args: _P.args, **kwargs: _P.kwargs) -> _T:
            if torch.is_grad_enabled():
                raise ArgumentError(
                    f"create_graph: {what} has first derivatives only; for second ones, as of hvp and gradient "
                    f"penalties, use {instead}"
                )
            return backward(*args, **kwargs)

        return guarded

    return decorate


def chained(gradient: Tensor, grad: Tensor) -> Tensor:
    """Return gradient * grad. grad () is almost always 1, and needless passes over an image would wake torch's threads.

    A GPU is not asked for its value, because that synchronises.
    """
    return gradient if grad.device.type == "cpu" and float(grad) == 1.0 else gradient * grad

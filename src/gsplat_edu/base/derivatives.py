"""For functions whose gradient is computed by hand: what torch's own tools may do with them, and the chain rule.

The kernels are not made of torch's operations. So torch.compile cannot look into them, autocast has nothing to lower,
and what differentiates or batches operations (torch.func, second derivatives) is refused in one line.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError

_P = ParamSpec("_P")
_T = TypeVar("_T")
_Function = TypeVar("_Function", bound=type[torch.autograd.Function])

HALVES = (torch.float16, torch.bfloat16)
"""Dtypes of half the precision, in which nothing here computes."""


def first_derivative_only(what: str, instead: str) -> Callable[[_Function], _Function]:
    """Guard a `torch.autograd.Function` whose backward pass is a kernel; its forward pass becomes `opaque`.

    Autograd enables gradients in a backward pass exactly if that pass itself is to be differentiated (`create_graph`).
    torch's `once_differentiable` then raises only if the incoming gradient depends on an input, and leaves a second
    derivative of zero otherwise, as for the sum of an image; so this guard raises whenever a graph is asked for.
    Forward-mode derivatives and the transforms of torch.func are refused as well.

    Args:
        what: What has first derivatives only, for the message.
        instead: What has second ones.
    """

    def decorate(function: _Function) -> _Function:
        backward, inherited = function.backward, function.apply

        @opaque
        @functools.wraps(backward)
        def guarded(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
            if torch.is_grad_enabled():
                raise ArgumentError(
                    f"create_graph: {what} has first derivatives only; for second ones, as of hvp and gradient "
                    f"penalties, use {instead}"
                )
            return backward(*args, **kwargs)

        def forward_mode(*args: object) -> None:
            raise ArgumentError(f"jvp: {what} has derivatives by backward() only; for jvp, use {instead}")

        @opaque
        def apply(*args: Any) -> Any:  # noqa: ANN401
            if inside_torch_func():
                raise ArgumentError(
                    f"torch.func: {what} has derivatives by backward() only; for grad and jvp, use {instead}"
                )
            return inherited(*args)  # type: ignore[no-untyped-call]

        for name, method in (("backward", guarded), ("jvp", forward_mode), ("apply", apply)):
            setattr(function, name, staticmethod(method))
        return function

    return decorate


def inside_torch_func() -> bool:
    """Return whether a transform of torch.func is active: grad, jvp, vmap or one made of them."""
    return bool(torch._C._are_functorch_transforms_active())


def refuse_vmap(instead: str) -> None:
    """Refuse to run inside `torch.vmap`, and so inside `torch.func.hessian`, `jacrev` and `jacfwd`.

    Args:
        instead: What to do instead, for the message.

    Raises:
        ArgumentError: it runs inside.
    """
    if inside_torch_func():
        active = torch._C._functorch.get_interpreter_stack() or []
        if any(each.key() == torch._C._functorch.TransformType.Vmap for each in active):
            raise ArgumentError(
                f'vmap: what is drawn depends on values, on backend="torch" as well; {instead}'
            )


def opaque(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Decorate a function that runs the same inside torch.compile and autocast as outside.

    torch.compile leaves it out of its graph. Under autocast, it computes in the precision of its inputs; tensors of
    half the precision become float32.
    """
    uncompiled: list[Callable[_P, _T]] = []

    @functools.wraps(function)
    def in_full_precision(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        active = [device for device in ("cpu", "cuda") if torch.is_autocast_enabled(device)]
        if not active:
            return function(*args, **kwargs)
        with ExitStack() as off:
            for device in active:
                off.enter_context(torch.autocast(device, enabled=False))
            full = {name: _in_full_precision(value) for name, value in kwargs.items()}
            return function(*map(_in_full_precision, args), **full)  # type: ignore[arg-type]

    @functools.wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        if not (torch.compiler.is_compiling() or "torch._dynamo" in sys.modules):
            return in_full_precision(*args, **kwargs)
        if not uncompiled:  # not at once: it takes torch a second to import its compiler
            uncompiled.append(torch.compiler.disable(in_full_precision))  # type: ignore[no-untyped-call]
        return uncompiled[0](*args, **kwargs)

    return run


def _in_full_precision(value: object) -> object:
    return value.float() if isinstance(value, Tensor) and value.dtype in HALVES else value


def refuse_halves(name: str, tensor: Tensor) -> None:
    """Refuse a tensor of half the precision.

    Args:
        name: Its name for the message.
        tensor: Any tensor.

    Raises:
        ArgumentError: it is float16 or bfloat16.
    """
    if tensor.dtype in HALVES:
        dtype = str(tensor.dtype).removeprefix("torch.")
        raise ArgumentError(
            f"{name}: is {dtype}, which is too coarse to render or to compare; use {name}.float()"
        )


def chained(gradient: Tensor, grad: Tensor) -> Tensor:
    """Return gradient * grad. grad () is almost always 1, and needless passes over an image would wake torch's threads.

    A GPU is not asked for its value, because that synchronises.
    """
    return gradient if grad.device.type == "cpu" and float(grad) == 1.0 else gradient * grad

"""Adam, one rate per parameter group, with moments that follow their Gaussians through density control.

Chapter: 12_the_backward_pass.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping

import torch
from jaxtyping import Int64
from torch import Tensor

from gsplat_edu import kernels
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.train.saved import check_entries, check_not_negative, check_tensor_kind

NUMBERS = ("rate", "beta1", "beta2", "eps", "correction1", "correction2")
"""What a step takes besides tensors, in the order of the implementations' last argument."""

MOMENTS = ("first", "second")
"""What Adam keeps for each parameter: decaying means of its gradient and of the gradient's square."""


class Adam:
    """Adam over the raw parameters of Gaussians.

    m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g²
    p -= rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

    The step count t is shared by all and survives density control, as in Kerbl et al.'s code. On the CPU a
    step is one native pass over each parameter, the same to the bit on any number of threads; on a GPU it is one
    kernel. Where the native module is not there it is torch's.

    Args:
        gaussians: The parameters to move.
        learning_rates: Rate of every parameter by name; one that is not named does not move.
        betas: Decay of the first and second moment.
        eps: Floor under the root of the second moment.

    Raises:
        ArgumentError: a rate is given for something that is not a parameter.

    Source: Kingma and Ba 2015, algorithm 1.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        learning_rates: Mapping[str, float],
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        tensors = gaussians.tensors()
        if unknown := sorted(set(learning_rates) - set(tensors)):
            raise ArgumentError(
                f"learning_rates: {unknown[0]!r} is none of the parameters {', '.join(tensors)}"
            )
        self.learning_rates, self.betas, self.eps = dict(learning_rates), betas, eps
        self.steps = 0
        self.first = {
            name: torch.zeros_like(tensors[name], memory_format=torch.contiguous_format)
            for name in self.learning_rates
        }
        self.second = {
            name: torch.zeros_like(tensors[name], memory_format=torch.contiguous_format)
            for name in self.learning_rates
        }

    @torch.no_grad()
    def step(self, gaussians: Gaussians) -> None:
        """Move every parameter that has a gradient, in place, and drop the gradients."""
        self.steps += 1
        b1, b2 = self.betas
        tensors = gaussians.tensors()
        for name, rate in self.learning_rates.items():
            parameter, m, v = tensors[name], self.first[name], self.second[name]
            if parameter.grad is None:
                continue
            numbers = (rate, b1, b2, self.eps, 1 - b1**self.steps, 1 - b2**self.steps)
            for moment in (m, v):
                if moment.shape != parameter.shape:
                    raise ArgumentError(
                        f"{name}: has shape {tuple(parameter.shape)}, its moments {tuple(moment.shape)};"
                        " call follow"
                    )
                if (moment.dtype, moment.device) != (parameter.dtype, parameter.device):
                    raise ArgumentError(
                        f"{name}: is {parameter.dtype} on {parameter.device}, its moments are {moment.dtype} on"
                        f" {moment.device}"
                    )
            step = _step_on_gpu if _gpu_takes(parameter) else _step_in_torch
            (_step_natively if _native_takes(parameter) else step)(parameter, m, v, numbers)
        for parameter in tensors.values():
            parameter.grad = None

    @torch.no_grad()
    def forget(self, name: str) -> None:
        """Set a parameter's moments to zero, where it was changed by hand."""
        for moments in (self.first, self.second):
            if name in moments:
                moments[name].zero_()

    @torch.no_grad()
    def forget_rows(self, indices: Int64[Tensor, " S"]) -> None:
        """Set all moments of some Gaussians to zero, where those were changed by hand."""
        for moments in (self.first, self.second):
            for moment in moments.values():
                moment[indices] = 0.0

    @torch.no_grad()
    def follow(self, survivors: Int64[Tensor, " S"], num_new: int) -> None:
        """Carry the moments through a change of the Gaussians.

        Args:
            survivors: (S,) indices of the Gaussians that stay, in their new order; they keep their moments.
            num_new: Gaussians added behind them, which start from zero moments.
        """
        for moments in (self.first, self.second):
            for name, old in moments.items():
                moments[name] = torch.cat([old[survivors], old.new_zeros(num_new, *old.shape[1:])])

    def state(self) -> tuple[dict[str, dict[str, Tensor]], int]:
        """Return the moments, as "first" and "second", and the number of steps taken."""
        return {name: getattr(self, name) for name in MOMENTS}, self.steps

    def load_state(self, moments: dict[str, dict[str, Tensor]], steps: int, gaussians: Gaussians) -> None:
        """Restore what `state` returned.

        Raises:
            ArgumentError: a moment is missing, or differs from its parameter in dtype or shape; nothing has changed.
        """
        for part in MOMENTS:
            given = check_entries(part, moments[part], tuple(self.learning_rates))
            for name, moment in given.items():
                parameter = getattr(gaussians, name)
                check_tensor_kind(f"{part}.{name}", moment, parameter.dtype, parameter.shape)
        for name, moment in moments["second"].items():
            check_not_negative(f"second.{name}", moment)
        self.first, self.second = (
            {name: moment.to(gaussians.means.device) for name, moment in moments[part].items()}
            for part in MOMENTS
        )
        self.steps = steps


def _native_takes(parameter: Tensor) -> bool:
    here = (
        parameter.device.type == "cpu" and parameter.dtype in kernels.SUFFIXES and parameter.is_contiguous()
    )
    return here and kernels.REASON is None


def _gpu_takes(parameter: Tensor) -> bool:
    here = parameter.device.type == "cuda" and parameter.dtype == torch.float32 and parameter.is_contiguous()
    return here and importlib.util.find_spec("triton") is not None


def _step_on_gpu(parameter: Tensor, m: Tensor, v: Tensor, numbers: tuple[float, ...]) -> None:
    from gsplat_edu.render.triton.adam import adam_triton

    if parameter.grad is not None:
        with torch.cuda.device_of(parameter):  # type: ignore[no-untyped-call]
            adam_triton(parameter, m, v, parameter.grad, numbers)


def _step_natively(parameter: Tensor, m: Tensor, v: Tensor, numbers: tuple[float, ...]) -> None:
    gradient = parameter.grad
    if gradient is not None:
        kernels.kernel("adam_f", parameter.dtype)(
            parameter=kernels.native_array(parameter),
            first=kernels.native_array(m),
            second=kernels.native_array(v),
            gradient=kernels.native_array(gradient.to(parameter.dtype).contiguous()),
            **dict(zip(NUMBERS, numbers, strict=True)),
            threads=torch.get_num_threads(),
        )
        torch.autograd.graph.increment_version(parameter)  # so that autograd knows of the change


def _step_in_torch(parameter: Tensor, m: Tensor, v: Tensor, numbers: tuple[float, ...]) -> None:
    rate, b1, b2, eps, correction1, correction2 = numbers
    gradient = parameter.grad
    if gradient is not None:
        m.mul_(b1).add_(gradient, alpha=1 - b1)
        v.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
        parameter -= rate * (m / correction1) / ((v / correction2).sqrt() + eps)

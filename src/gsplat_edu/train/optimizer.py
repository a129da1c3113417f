"""Adam over named parameter groups, with moments that follow their Gaussians through density control.

Chapter: 12_the_backward_pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import torch
from jaxtyping import Int64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.adam import AdamKernel, adam_natively
from gsplat_edu.ops.moments import AdamInBackward, AdamNumbers, Moments
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.saved import check_entries, check_not_negative, check_tensor_kind

MOMENTS = ("first", "second")
"""Adam's state for each parameter: decaying means of its gradient and of the squared gradient."""

RAW = tuple(field.name for field in fields(Gaussians))
"""Names of the Gaussians' raw parameters."""


@dataclass(frozen=True)
class ParameterGroup:
    """Adam's settings for one named tensor.

    Args:
        rate: Learning rate, or a schedule that returns it for an iteration counted from 0.
        eps: Added to the root of the second moment.
        betas: Decay of the first and second moment.
        per_gaussian: Whether the tensor has a row for each Gaussian. Only the moments of such a group follow density
            surgery; those of other groups (exposures, poses) are unaffected.
    """

    rate: float | Callable[[int], float]
    eps: float = 1e-8
    betas: tuple[float, float] = (0.9, 0.999)
    per_gaussian: bool = True

    def rate_at(self, iteration: int) -> float:
        """Return the rate at an iteration."""
        return self.rate(iteration) if callable(self.rate) else self.rate


class Adam:
    """Adam over named tensors, each with its own rate, eps and schedule.

    m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g²
    p -= rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

    The step count t is shared by all groups and survives density control, as in Kerbl et al.'s code.

    A step whose gradients are the mean over B views stands for B steps: rate sqrt(B), eps / sqrt(B) and b1^B, b2^B
    replace the numbers of one view, and t counts views (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting
    Training").

    Args:
        parameters: The tensors by name.
        groups: Settings by the same names; a number stands for a group with that rate. Tensors without a group do not
            change.
        kernel: Updates one tensor; see `Backend.adam`.

    Raises:
        ArgumentError: a group has no parameter.

    Attributes:
        groups: The groups by name.
        learning_rates: Rate of the next step by group; `schedule` sets them.
        steps: Number of views in all steps taken; with B = 1, the number of steps.
        first: First moments by group.
        second: Second moments by group.

    Source: Kingma and Ba 2015, algorithm 1.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        groups: Mapping[str, float | ParameterGroup],
        kernel: AdamKernel = adam_natively,
    ) -> None:
        if unknown := sorted(set(groups) - set(parameters)):
            raise ArgumentError(
                f"groups: {unknown[0]!r} is not one of the parameters {', '.join(parameters)}"
            )
        self.groups = {
            name: group if isinstance(group, ParameterGroup) else ParameterGroup(group)
            for name, group in groups.items()
        }
        self._kernel = kernel
        self.learning_rates: dict[str, float] = {}
        self._views = 1
        self.schedule(0)
        self.steps = 0
        self.first, self.second = (
            {
                name: torch.zeros_like(parameters[name], memory_format=torch.contiguous_format)
                for name in self.groups
            }
            for _ in MOMENTS
        )

    def schedule(self, iteration: int, views: int = 1) -> None:
        """Set the numbers of the next step.

        Args:
            iteration: Its first image, counted from 0.
            views: B, the number of views whose mean gradient it takes.
        """
        self._views, root = views, math.sqrt(views)
        self.learning_rates = {name: root * group.rate_at(iteration) for name, group in self.groups.items()}

    def advance(self) -> dict[str, AdamNumbers]:
        """Count a step, and return its numbers by group; something else then moves parameters and moments."""
        views, root = self._views, math.sqrt(self._views)
        self.steps += views
        found = {}
        for name, group in self.groups.items():
            b1, b2 = group.betas
            corrections = 1 - b1**self.steps, 1 - b2**self.steps
            eps = group.eps / root
            found[name] = AdamNumbers(self.learning_rates[name], b1**views, b2**views, eps, *corrections)
        return found

    @torch.no_grad()
    def step(self, parameters: Mapping[str, Tensor], in_backward: AdamInBackward | None = None) -> None:
        """Update every parameter that has a gradient, in place, and clear the gradients.

        Args:
            parameters: The tensors by name: those given to the constructor, or their replacements by density surgery.
            in_backward: Updates the raw parameters of the Gaussians as the rest of their backward pass; see
                `RenderOutput.defer`. Their `grad` then holds only what did not come from the render.

        Raises:
            ArgumentError: the moments of a group do not fit its parameter.
        """
        deferred: dict[str, Moments] = {}
        for name, numbers in self.advance().items():
            parameter, m, v = parameters[name], self.first[name], self.second[name]
            if in_backward is not None and name in RAW:
                _check_moments(name, parameter, (m, v))
                deferred[name] = Moments(m, v, parameter.grad, numbers)
            elif parameter.grad is not None:
                _check_moments(name, parameter, (m, v))
                self._kernel(parameter, m, v, parameter.grad, numbers)
        if in_backward is not None:
            in_backward(deferred)
        for parameter in parameters.values():
            parameter.grad = None

    @torch.no_grad()
    def forget(self, name: str) -> None:
        """Set a group's moments to zero, after its parameter was changed directly."""
        for moments in (self.first, self.second):
            if name in moments:
                moments[name].zero_()

    @torch.no_grad()
    def forget_rows(self, indices: Int64[Tensor, " S"]) -> None:
        """Set the moments of some Gaussians to zero, after these were changed directly."""
        for moments in (self.first, self.second):
            for name, moment in moments.items():
                if self.groups[name].per_gaussian:
                    moment[indices] = 0.0

    @torch.no_grad()
    def follow(self, origins: Int64[Tensor, " M"]) -> None:
        """Apply a change of the Gaussians to the moments of the per-Gaussian groups.

        Args:
            origins: (M,) for each Gaussian after the change its index before it, whose moments it keeps; -1 for a new
                one, whose moments start at zero.
        """
        for moments in (self.first, self.second):
            for name, old in moments.items():
                if self.groups[name].per_gaussian:
                    moments[name] = _rows_from(old, origins)

    def state(self) -> tuple[dict[str, dict[str, Tensor]], int]:
        """Return the moments, as "first" and "second", and the number of views of the steps taken."""
        return {name: getattr(self, name) for name in MOMENTS}, self.steps

    def load_state(
        self, moments: Mapping[str, Mapping[str, Tensor]], steps: int, parameters: Mapping[str, Tensor]
    ) -> None:
        """Restore what `state` returned.

        Args:
            moments: "first" and "second", by group.
            steps: Views of the steps taken.
            parameters: The parameters of the moments.

        Raises:
            ArgumentError: a moment is missing or differs from its parameter in dtype or shape; nothing has changed.
        """
        for part in MOMENTS:
            given = check_entries(part, moments[part], tuple(self.groups))
            for name, moment in given.items():
                check_tensor_kind(f"{part}.{name}", moment, parameters[name].dtype, parameters[name].shape)
        for name, moment in moments["second"].items():
            check_not_negative(f"second.{name}", moment)
        self.first, self.second = (
            {name: moment.to(parameters[name].device) for name, moment in moments[part].items()}
            for part in MOMENTS
        )
        self.steps = steps


@torch.no_grad()
def carry_state(
    optimizer: torch.optim.Optimizer, before: Gaussians, after: Gaussians, origins: Int64[Tensor, " M"]
) -> None:
    """Put changed Gaussians in the place of the old ones in an optimiser of torch; survivors keep their state.

    State of a parameter's shape (moments, momentum) follows its rows. Counts of steps stay.

    Args:
        optimizer: Has some or all of the parameters of `before`, in any groups.
        before: The N Gaussians before the change.
        after: The M Gaussians after it, leaves that collect gradients.
        origins: (M,) for each Gaussian after the change its index before it, whose state it keeps; -1 for a new one,
            whose state starts at zero.

    Raises:
        ArgumentError: an index is out of range or their number is not M, the optimiser has none of the parameters, a
            new parameter is no leaf that collects gradients, or the state has another shape (LBFGS, Adafactor);
            nothing has changed.
    """
    if origins.shape != (len(after),):
        raise ArgumentError(f"origins: has shape {tuple(origins.shape)}, but has to be ({len(after)},)")
    if len(origins) and not (int(origins.min()) >= -1 and int(origins.max()) < len(before)):
        raise ArgumentError(f"origins: names a Gaussian beyond the {len(before)} before the change")
    names = {id(tensor): name for name, tensor in before.tensors().items()}
    replaced: dict[Tensor, Tensor] = {}
    for old in (p for group in optimizer.param_groups for p in group["params"] if id(p) in names):
        name, new = names[id(old)], getattr(after, names[id(old)])
        if not (new.is_leaf and new.requires_grad):
            raise ArgumentError(f"after: {name} has to be a leaf that collects gradients; call trainable()")
        for key, value in optimizer.state.get(old, {}).items():
            if isinstance(value, (list, dict)) or (
                isinstance(value, Tensor) and value.ndim and value.shape != old.shape
            ):
                kind = type(optimizer).__name__
                raise ArgumentError(f"optimizer: {key} of {kind} has no row for each Gaussian")
        replaced[old] = new
    if not replaced:
        raise ArgumentError("optimizer: has none of the parameters of these Gaussians")
    for old, new in replaced.items():
        if old in optimizer.state:
            optimizer.state[new] = {
                key: _rows_from(value, origins) if isinstance(value, Tensor) and value.ndim else value
                for key, value in optimizer.state.pop(old).items()
            }
    for group in optimizer.param_groups:
        group["params"] = [replaced.get(old, old) for old in group["params"]]


def _rows_from(old: Tensor, origins: Int64[Tensor, " M"]) -> Tensor:
    """Return the rows of a tensor at these indices, zeros for -1."""
    rows = torch.where(origins < 0, len(old), origins)
    return torch.cat([old, old.new_zeros(1, *old.shape[1:])]).index_select(0, rows)


def _check_moments(name: str, parameter: Tensor, moments: tuple[Tensor, Tensor]) -> None:
    for moment in moments:
        if moment.shape != parameter.shape:
            raise ArgumentError(
                f"{name}: has shape {tuple(parameter.shape)}, but its moments {tuple(moment.shape)}; call follow"
            )
        if (moment.dtype, moment.device) != (parameter.dtype, parameter.device):
            raise ArgumentError(
                f"{name}: is {parameter.dtype} on {parameter.device}, but its moments {moment.dtype} on {moment.device}"
            )

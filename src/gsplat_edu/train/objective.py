"""The objective of a step: a sum of named terms, each a scalar that autograd can differentiate.

Parts of a training (`gsplat_edu.train.part`) add terms; the log, the report and the checkpoints need no change.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.buffers import reusable_tensor
from gsplat_edu.base.derivatives import chained, first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.ops.losses import LossKernel, photo_loss
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.events import PHOTO as PHOTO
from gsplat_edu.train.far import Shell
from gsplat_edu.train.rendered import NOTHING, Needs, Rendered as Rendered

FEW_VISIBLE = 0.25
"""Regularise only the visible Gaussians if they are fewer than this fraction of all. Views of one subject show at least
a third of the start's Gaussians, views of an aerial capture of a city a tenth
(the earlier results that benchmarks/RESULTS.md names)."""


@runtime_checkable
class Term(Protocol):
    """One summand of an objective.

    An attribute `needs` (`Needs`) says what it reads of a render besides image and transmittance; without it, those of
    every pixel.
    """

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return the weighted value, differentiable in what the step learns."""
        ...


class Objective:
    """The sum of named terms.

    Args:
        terms: The terms by name, including "photo".

    Raises:
        ArgumentError: there is no term "photo".
    """

    def __init__(self, terms: Mapping[str, Term]) -> None:
        if PHOTO not in terms:
            raise ArgumentError(f"terms: have to include {PHOTO!r}, which logs and progress call the loss")
        self.terms = dict(terms)

    def needs(self, iteration: int) -> Needs:
        """Return what the terms read in the step of an iteration."""
        own = NOTHING if type(self) is Objective else Needs()  # a subclass may read more than its terms
        each = (getattr(term, "needs", Needs()).at(iteration) for term in self.terms.values())
        return functools.reduce(operator.or_, each, own)

    def backward(self, rendered: Rendered) -> dict[str, Float[Tensor, ""]]:
        """Add the gradients of the sum to the `grad` of its leaves; return the value of every term, detached."""
        values = {name: self._value(name, rendered) for name in self.terms}
        sum_of_scalars(list(values.values())).backward()  # type: ignore[no-untyped-call]
        return {name: value.detach() for name, value in values.items()}

    def _value(self, name: str, rendered: Rendered) -> Float[Tensor, ""]:
        """Return a term's value.

        Raises:
            ArgumentError: the term reads the depth without saying so.
        """
        try:
            return self.terms[name](rendered)
        except (AttributeError, TypeError) as error:
            if rendered.output.depth is not None or "NoneType" not in str(error):
                raise
            raise ArgumentError(
                f"terms[{name!r}]: reads output.depth, which is rendered only for terms with needs = Needs(depth=True)"
            ) from error


def sum_of_scalars(values: Sequence[Float[Tensor, ""]]) -> Float[Tensor, ""]:
    """Return the sum of scalars, left to right."""
    first, *others = values
    for value in others:
        first = first + value
    return first


def joined_terms(terms: Mapping[str, Term], others: Mapping[str, Term]) -> dict[str, Term]:
    """Return the terms of both by name.

    Raises:
        ArgumentError: a name is in both.
    """
    if taken := sorted(set(terms) & set(others)):
        raise ArgumentError(f"terms: two are named {taken[0]!r}; rename that of the part")
    return {**terms, **others}


def make_objective(
    config: TrainConfig,
    shell: Shell | None = None,
    loss: LossKernel | None = None,
    others: Mapping[str, Term] | None = None,
) -> Objective:
    """Make the objective of a configuration: the photo term, the regularisers of its strategy, and the parts' terms.

    (1 - k) L1 + k (1 - SSIM), for mcmc and fast + weight_o mean(opacity), and for mcmc + weight_s mean(scale)

    For fast, the opacity is averaged over the visible Gaussians if they are few. Adam moves a parameter by its full
    rate if all its gradients agree, however small they are. If each view shows a twentieth of the scene, invisible
    Gaussians would fade before a photo needs them. In smaller scenes, Gaussians that few photos show are meant to fade.

    Args:
        config: The configuration.
        shell: Where far splats lie, whose scale is not regularised; None if there are none.
        loss: Compares images and photos; see `photo_loss`.
        others: The terms of parts by name.

    Raises:
        ArgumentError: a part's term has the name of one of ours.

    Source: Kerbl et al. 2023, eq. 7; Kheradmand et al. 2024, eq. 10.
    """
    terms: dict[str, Term] = {PHOTO: PhotoTerm(config.ssim_weight, loss)}
    if config.strategy == "mcmc":
        terms["opacity"] = MeanOpacity(config.mcmc.opacity_weight)
        terms["scale"] = MeanScale(config.mcmc.scale_weight, shell)
    if config.strategy == "fast" and config.fast.opacity_weight > 0:
        terms["opacity"] = MeanOpacity(config.fast.opacity_weight, config.fast.stop, FEW_VISIBLE)
    return Objective(joined_terms(terms, others or {}))


@dataclass(frozen=True)
class PhotoTerm:
    """The difference between image and photo: `gsplat_edu.ops.losses.photo_loss`.

    Args:
        ssim_weight: k, 0 to 1.
        loss: Compares them; `Backend.loss` of the backend that renders. The native loss if None.
    """

    ssim_weight: float
    loss: LossKernel | None = None
    needs: ClassVar[Needs] = NOTHING

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return (1 - k) L1 + k (1 - SSIM)."""
        target = rendered.target
        return photo_loss(rendered.image, target.image, target.mask, self.ssim_weight, self.loss)


@dataclass(frozen=True)
class MeanOpacity:
    """Keeps opacities small, so that superfluous Gaussians die.

    Args:
        weight: lambda_o.
        until: The term is 0 from this iteration on; None for the whole run.
        least_share: Average over the visible Gaussians only if they are a smaller fraction than this.
    """

    weight: float
    until: int | None = None
    least_share: float = 0.0
    needs: ClassVar[Needs] = NOTHING

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return weight mean(opacity)."""
        if self.until is not None and rendered.iteration >= self.until:
            return rendered.gaussians.logit_opacities.new_zeros(())
        logits, visible = rendered.gaussians.logit_opacities, rendered.output.visible
        some = visible if len(visible) < self.least_share * len(logits) else None
        value: Tensor = _MeanOpacity.apply(logits, self.weight, some)  # type: ignore[no-untyped-call]
        return value


@dataclass(frozen=True)
class MeanScale:
    """Keeps scales small.

    Args:
        weight: lambda_Sigma.
        shell: Where far splats lie, which count as having no scale; None if there are none.
    """

    weight: float
    shell: Shell | None = None
    needs: ClassVar[Needs] = NOTHING

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return weight mean(scale)."""
        gaussians = rendered.gaussians
        far = None if self.shell is None else self.shell.holds(gaussians.means)
        value: Tensor = _MeanScale.apply(gaussians.log_scales, self.weight, far)  # type: ignore[no-untyped-call]
        return value


@first_derivative_only("the mean opacity", "weight * torch.sigmoid(logits).mean()")
class _MeanOpacity(torch.autograd.Function):
    """Compute weight mean(sigmoid(l)) of all or some, with the gradient weight o (1 - o) / N, in reused buffers.

    The rounding of torch's sigmoid depends on the number of threads, so one thread computes it.
    """

    @staticmethod
    def forward(ctx: Any, logits: Tensor, weight: float, some: Tensor | None) -> Tensor:  # noqa: ANN401
        with one_thread():
            chosen = logits if some is None else logits[some]
            count = max(chosen.numel(), 1)
            opacities = torch.sigmoid(chosen, out=reusable_tensor(chosen.shape, chosen))
            value = weight * opacities.sum() / count
            others = torch.neg(opacities, out=reusable_tensor(chosen.shape, chosen)).add_(1)
            gradient = opacities.mul_(weight).mul_(others).div_(count)
            if some is not None:
                gradient = reusable_tensor(logits.shape, logits).zero_().index_copy_(0, some, gradient)
            ctx.save_for_backward(gradient)
            return value

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401
        (gradient,) = ctx.saved_tensors
        return chained(gradient, grad), None, None


@first_derivative_only("the mean scale", "weight * log_scales.exp().mean()")
class _MeanScale(torch.autograd.Function):
    """Compute weight mean(exp(l)), with the gradient weight exp(l) / N; on one thread, as above."""

    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, weight: float, far: Tensor | None) -> Tensor:  # noqa: ANN401
        with one_thread():
            scales = torch.exp(log_scales, out=reusable_tensor(log_scales.shape, log_scales))
            if far is not None:
                scales[far] = 0.0
            gradient = scales.mul_(weight).div_(max(log_scales.numel(), 1))
            ctx.save_for_backward(gradient)
            return gradient.sum()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401
        (gradient,) = ctx.saved_tensors
        return chained(gradient, grad), None, None

"""Inputs of a step of Adam apart from the parameter and its gradient: the moments, and the step's numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from torch import Tensor


class AdamNumbers(NamedTuple):
    """The numbers of one step.

    Args:
        rate: Learning rate.
        beta1: Decay rate of the first moment, 0 to 1.
        beta2: Decay rate of the second moment, 0 to 1.
        eps: Floor under the root of the second moment.
        correction1: 1 - beta1^t, with t the number of steps including this one.
        correction2: 1 - beta2^t.
    """

    rate: float
    beta1: float
    beta2: float
    eps: float
    correction1: float
    correction2: float


class Moments(NamedTuple):
    """The state of one tensor for a step in the backward pass, which computes the gradient itself.

    Args:
        first: Decaying mean of the gradient, of the parameter's shape.
        second: Decaying mean of the squared gradient, likewise.
        extra: Another part of the gradient, to be added; None for none.
        numbers: The numbers of the step.
    """

    first: Tensor
    second: Tensor
    extra: Tensor | None
    numbers: AdamNumbers


AdamInBackward = Callable[[Mapping[str, Moments]], None]
"""Moves the rendered Gaussians and their moments in place, given the moments of every raw parameter by name."""

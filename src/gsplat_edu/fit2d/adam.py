"""Adam for 2D splats: each value moves by its gradient divided by the gradient's typical size.

Chapter: 08_fit_an_image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.validation import in_range
from gsplat_edu.fit2d.splats import PER_SPLAT, Splats2D

RATES_2D: Mapping[str, float] = MappingProxyType(
    {"means": 0.8, "log_scales": 0.1, "angles": 0.1, "colors": 0.05, "logit_opacities": 0.1}
)
"""Learning rates by parameter: the approximate size of a step, in the parameter's unit (px, 1, radians, 1, 1)."""


@dataclass(frozen=True)
class AdamSettings:
    """Settings of Adam.

    m = b1 m + (1 - b1) g,  v = b2 v + (1 - b2) g²
    p -= rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

    Args:
        rates: Learning rate of every parameter by name.
        betas: b1 and b2, decay of the first and second moment, 0 to below 1.
        eps: Added to the root of the second moment.

    Raises:
        ArgumentError: a rate is missing, negative or belongs to no parameter, or another number is out of range.

    Source: Kingma and Ba 2015, algorithm 1.
    """

    rates: Mapping[str, float] = field(default_factory=lambda: RATES_2D)
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-12

    def __post_init__(self) -> None:
        """Check names and ranges."""
        if different := sorted(set(self.rates) ^ set(PER_SPLAT)):
            wrong = "is missing" if different[0] in PER_SPLAT else "is not a parameter"
            raise ArgumentError(f"rates: {different[0]!r} {wrong}; the parameters are {', '.join(PER_SPLAT)}")
        for name, rate in self.rates.items():
            in_range(f"rates[{name!r}]", rate, 0.0)
        for beta in self.betas:
            in_range("betas", beta, 0.0, float(np.nextafter(1.0, 0.0)))
        in_range("eps", self.eps, 0.0, open_low=True)


@dataclass(frozen=True)
class AdamState:
    """State of Adam.

    Args:
        first: Running mean of the gradients.
        second: Running mean of their squares.
        steps: Number of steps taken, t.
    """

    first: Splats2D
    second: Splats2D
    steps: int = 0

    @classmethod
    def fresh(cls, splats: Splats2D) -> AdamState:
        """Return the initial state."""
        return cls(splats.map(np.zeros_like), splats.map(np.zeros_like))


def adam_step_2d(
    splats: Splats2D, gradients: Splats2D, state: AdamState, settings: AdamSettings, factor: float = 1.0
) -> tuple[Splats2D, AdamState]:
    """Take one step of Adam; see `AdamSettings`. Nothing is modified in place.

    Args:
        splats: N splats.
        gradients: Gradients of the loss with respect to them.
        state: The state after the previous step.
        settings: Learning rates, decays, eps.
        factor: Multiplies all learning rates in this step.

    Returns:
        The splats and the state after the step.

    Raises:
        ShapeError: splats, gradients and state have different N.
    """
    for name, other in (("gradients", gradients), ("state", state.first)):
        if len(other) != len(splats):
            raise ShapeError(f"{name}: has {len(other)} splats, but there are {len(splats)}")
    b1, b2 = settings.betas
    steps = state.steps + 1
    at, slopes = splats.arrays(), gradients.arrays()
    first, second = state.first.arrays(), state.second.arrays()
    for name, g in slopes.items():
        first[name] = b1 * first[name] + (1.0 - b1) * g
        second[name] = b2 * second[name] + (1.0 - b2) * g * g
        m, v = first[name] / (1.0 - b1**steps), second[name] / (1.0 - b2**steps)
        at[name] = at[name] - factor * settings.rates[name] * m / (np.sqrt(v) + settings.eps)
    return Splats2D(**at), AdamState(Splats2D(**first), Splats2D(**second), steps)

"""The settings of one strategy each, and how a setting is declared.

Defaults are those of 30,000 iterations; `gsplat_edu.train.config` has the settings of all runs.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from gsplat_edu.train.checks import (
    OneOf,
    Whole,
    accept_at_least_1 as _at_least_1,
    accept_not_negative as _not_negative,
    accept_opacity as _opacity,
    accept_positive as _positive,
    accept_share as _share,
)
from gsplat_edu.train.setting import Check, Option

OVER_CAP = ("strongest", "cut")

Class = TypeVar("Class", bound=type)


def number(
    default: Any,  # noqa: ANN401
    check: Check,
    help: str,  # noqa: A002
    source: str = "",
    *,
    milestone: bool = False,
    option: Option | None = None,
    only: str = "",
    in_trials: bool = False,
) -> Any:  # noqa: ANN401
    """Declare a setting; see `gsplat_edu.train.setting.Setting` for the arguments."""
    metadata = {
        "check": check,
        "help": help,
        "source": source,
        "milestone": milestone,
        "option": option,
        "only": only,
        "in_trials": in_trials,
    }
    return dataclasses.field(default=default, metadata=metadata)


def documented(kind: Class) -> Class:
    """Add the help texts of the settings to a class's docstring, as its arguments."""
    lines = [f"    {field.name}: {field.metadata['help']}" for field in fields(kind) if field.metadata]
    kind.__doc__ = "\n".join([f"{(kind.__doc__ or '').rstrip()}", "", "Args:", *lines, ""])
    return kind


@documented
@dataclass(frozen=True)
class AdcConfig:
    """Settings of adaptive density control: clone, split, prune, reset."""

    over_cap: str = number(
        "strongest",
        OneOf(OVER_CAP),
        'Which Gaussians are cloned or split if the cap leaves too little room. "strongest": those with the largest'
        ' gradients; "cut": all, and what exceeds the cap is dropped from the end of the order survivors, clones,'
        " children, which the Gaussians then keep; the parent of dropped children is removed too (the course).",
        only="course",
    )
    densify_stop: int = number(
        15_000, Whole(0), "Densification ends before this iteration.", "2023", milestone=True
    )
    grad_threshold: float = number(
        2e-4,
        _not_negative,
        "Clone or split Gaussians whose mean image-plane gradient norm, in normalised device coordinates, exceeds"
        " this.",
        "2023",
    )
    percent_dense: float = number(
        0.01,
        _not_negative,
        "Fraction of the extent: Gaussians of a larger scale are split, smaller ones cloned.",
        "2023",
    )
    split_shrink: float = number(
        1.6, _positive, "Divisor of the scales of the two children of a split.", "2023"
    )
    prune_scale: float = number(
        0.1,
        _not_negative,
        "Fraction of the extent: once opacities have been reset, Gaussians of a larger scale are pruned; 0 prunes"
        " none.",
        "2023",
    )
    reset_every: int = number(
        3_000,
        Whole(0),
        "Iterations between resets of the opacities while densifying; 0 never resets.",
        "2023",
        milestone=True,
    )
    reset_opacity: float = number(0.01, _opacity, "Upper bound of opacities after a reset.", "2023")


@documented
@dataclass(frozen=True)
class McmcConfig:
    """Settings of Markov chain Monte Carlo: relocate, grow, add noise, regularise."""

    stop: int = number(
        25_000, Whole(0), "Relocation and growth end before this iteration.", "2024's code", milestone=True
    )
    start_opacity: float = number(
        0.5, _opacity, "Opacity of the initial Gaussians.", "2024's code", only="start"
    )
    start_scale: float = number(
        0.1,
        _positive,
        "Factor on the initial scales, which are the root mean squared distance to 3 neighbours.",
        "2024's code",
        only="start",
    )
    growth: float = number(
        1.05,
        _at_least_1,
        "Growth factor of the number of Gaussians per densification, up to the cap.",
        "2024, section 4.3",
    )
    noise: float = number(
        5e5,
        _not_negative,
        "Noise on the means, relative to their learning rate.",
        "2024, section 4.1: lambda_noise",
    )
    opacity_weight: float = number(
        0.01, _not_negative, "Weight of the mean opacity in the objective.", "2024, eq. 10: lambda_o"
    )
    scale_weight: float = number(
        0.01, _not_negative, "Weight of the mean scale in the objective.", "2024, eq. 10: lambda_Sigma"
    )


@documented
@dataclass(frozen=True)
class FastConfig:
    """Settings of the fast recipe: small photos first, a planned number of Gaussians, rates that fall to the end."""

    start_factor: float = number(
        4.0,
        _at_least_1,
        "Divisor of the photos' size at the start; it falls by sqrt 2 per step, each equally long, to 1.",
        "DashGaussian",
    )
    full_size: int = number(
        18_000, Whole(0), "Iteration from which photos have their full size.", "ours", milestone=True
    )
    stop: int = number(
        18_000, Whole(0), "Iteration at which the planned number is reached.", "ours", milestone=True
    )
    decay_start: int = number(
        21_000,
        Whole(0),
        "Iteration at which all rates but the means' begin to fall.",
        "ours",
        milestone=True,
    )
    opacity_weight: float = number(
        0.002,
        _not_negative,
        "Weight of the mean opacity in the objective until `fast_stop`: what no photo needs fades and is pruned.",
        "ours",
    )
    decay: float = number(
        0.1, _share, "Factor on these rates once the means' rate is final; log-linear between.", "ours"
    )

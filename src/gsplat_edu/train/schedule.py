"""Schedules: the means' learning rate and the degree of the harmonics."""

from __future__ import annotations

import functools
from collections.abc import Callable

from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.optimizer import ParameterGroup


def gaussian_groups(config: TrainConfig, extent: float) -> dict[str, ParameterGroup]:
    """Return the parameter groups of the Gaussians: one for each raw parameter, by name.

    Args:
        config: Rates, eps and the schedule of the means.
        extent: Size of the scene, world units.
    """
    rates: dict[str, float | Callable[[int], float]] = dict(config.learning_rates)
    rates["means"] = functools.partial(means_rate, config, extent)
    return {name: ParameterGroup(rate, eps=config.adam_eps) for name, rate in rates.items()}


def means_rate(config: TrainConfig, extent: float, iteration: int) -> float:
    """Return Adam's rate of the means: extent * start * (end / start)^t, log-linear in t from 0 to 1.

    Args:
        config: The rates, and the iteration that reaches the final one.
        extent: Size of the scene, world units.
        iteration: Counted from 0.

    Source: Kerbl et al. 2023's code.
    """
    start, end = config.means_rate, config.means_rate_final
    if start == end or start == 0.0:
        return extent * start
    t = min(iteration / config.means_rate_iterations, 1.0)
    return float(extent * start * (end / start) ** t)


def sh_degree(config: TrainConfig, iteration: int) -> int:
    """Return the degree of harmonics in use: 0 at first, one more every `sh_every` iterations."""
    if config.sh_every == 0:
        return config.sh_degree
    return min(config.sh_degree, iteration // config.sh_every)

"""Schedules: learning rates, degree of the harmonics, size of the photos, planned number of Gaussians."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Int64

from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.optimizer import ParameterGroup


def gaussian_groups(config: TrainConfig, extent: float) -> dict[str, ParameterGroup]:
    """Return the parameter groups of the Gaussians: one for each raw parameter, by name.

    Args:
        config: Rates, eps and the schedule of the means.
        extent: Size of the scene, world units.
    """
    rates: dict[str, float | Callable[[int], float]] = {
        name: functools.partial(decayed_rate, config, rate) if config.strategy == "fast" else rate
        for name, rate in config.learning_rates.items()
    }
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


def decayed_rate(config: TrainConfig, rate: float, iteration: int) -> float:
    """Return a learning rate of the fast recipe: constant, then log-linear to `decay` times itself.

    Args:
        config: The run.
        rate: The constant rate.
        iteration: Counted from 0.
    """
    start = config.fast.decay_start
    if iteration <= start:
        return rate
    t = (iteration - start) / max(config.means_rate_iterations - start, 1)
    return float(rate * config.fast.decay ** min(t, 1.0))


def milestone(iteration: int, every: int, batch: int) -> int | None:
    """Return the last multiple of `every` among the images of a step; None if there is none.

    Args:
        iteration: The last image of the step, counted from 0.
        every: The interval, images.
        batch: Number of images of the step.
    """
    multiple = iteration // every * every
    return multiple if multiple > iteration - batch else None


def photo_factor(config: TrainConfig, iteration: int) -> float:
    """Return the divisor of the photos' width and height: above 1 only early in the fast recipe.

    start_factor / sqrt(2)^k, at least 1, with k rising by 1 in each of equally long steps until `full_size`.

    Args:
        config: The run.
        iteration: Counted from 0.
    """
    start, full_size = config.fast.start_factor, config.fast.full_size
    if config.strategy != "fast" or iteration >= full_size:
        return 1.0
    steps = math.ceil(2 * math.log2(start) - 1e-9)  # until the factor is 1
    return float(max(start * 0.5 ** (steps * iteration // full_size / 2), 1.0))


def planned_counts(
    config: TrainConfig, start: int, cap: int, iterations: Int64[np.ndarray, " n"]
) -> Int64[np.ndarray, " n"]:
    """Return the fast recipe's planned numbers of Gaussians: linear from `start` at `densify_start` to `cap`.

    Args:
        config: The run; the cap is reached at `fast.stop`.
        start: Number of start Gaussians.
        cap: Number at the end.
        iterations: (n,) counted from 0.
    """
    window = max(config.fast.stop - config.densify_start, 1)
    t = np.clip((iterations - config.densify_start) / window, 0.0, 1.0)
    return np.rint(start + (cap - start) * t).astype(np.int64)


def sh_degree(config: TrainConfig, iteration: int) -> int:
    """Return the degree of harmonics in use: 0 at first, one more every `sh_every` iterations."""
    if config.sh_every == 0:
        return config.sh_degree
    return min(config.sh_degree, iteration // config.sh_every)

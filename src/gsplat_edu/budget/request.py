"""What a plan is asked for: the run, its limits, the options that the user gave, and the capture."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from gsplat_edu.base.text import easily_read, spelled_seconds
from gsplat_edu.budget.costs import Facts
from gsplat_edu.budget.deadline import Deadline
from gsplat_edu.budget.forecast import spelled_bytes
from gsplat_edu.budget.length import with_iterations
from gsplat_edu.budget.on_device import most_gaussians
from gsplat_edu.engine.room import Room
from gsplat_edu.runs.thin import ThinTrial
from gsplat_edu.runs.training import RunOptions
from gsplat_edu.train.config import RECIPE_ITERATIONS, TrainConfig
from gsplat_edu.train.length import DEFAULT_QUALITY, planned_iterations

GUARD = 1.5
"""adc: the cap as a multiple of the expected number of Gaussians, so that a scene that grows more keeps the time."""


@dataclass(frozen=True)
class Limits:
    """Limits of a run.

    Args:
        memory: Peak resident memory of the process, bytes; None for no limit.
        time: Time from the start of the command to its end; None for no limit.
    """

    memory: int | None = None
    time: Deadline | None = None

    @property
    def seconds(self) -> float | None:
        """The time limit in seconds, from the start of the command to its end; None for no limit."""
        return None if self.time is None else self.time.seconds

    def __str__(self) -> str:
        """Return the limits as command-line options."""
        memory = [] if self.memory is None else [f"--max-memory {spelled_bytes(self.memory)}"]
        seconds = [] if self.seconds is None else [f"--time-limit {spelled_seconds(self.seconds)}"]
        return " and ".join(memory + seconds)


@dataclass(frozen=True)
class Request:
    """Input of a plan.

    Args:
        options: The run as it would be without limits.
        limits: The limits.
        given: Names of `PLANNED` that the user gave.
        rescale: Whether milestones that are not given stretch with the iterations.
        facts: The capture at the size given by the user, or at the size of its files.
        factors: Allowed downscaling factors, ascending.
        trial: Of a capture with few photos; its longest training bounds the iterations.
        room: The device on which the training stays; None for the processor and CUDA.
    """

    options: RunOptions
    limits: Limits
    given: frozenset[str]
    rescale: bool
    facts: Facts
    factors: tuple[float, ...] = (1.0,)
    trial: ThinTrial | None = None
    room: Room | None = None

    @property
    def most_on_device(self) -> int | None:
        """How many Gaussians the device has room for, with the pairs of a trained scene; None without one."""
        return None if self.room is None else most_gaussians(self.room, self.options.config)

    @property
    def most_iterations(self) -> int:
        """Bound of the iterations that a time limit chooses."""
        longest = None if self.trial is None else self.trial.longest
        return RECIPE_ITERATIONS if longest is None else longest

    @property
    def full_length(self) -> int | None:
        """Iterations without a time limit; None if that is unknown: a run from a scene only continues another."""
        config = self.options.config
        if not self.by_time:
            return config.iterations
        if self.options.scene is not None:
            return None
        usual = planned_iterations(DEFAULT_QUALITY, max(self.facts.train, 1), batch=config.batch)
        return min(usual, self.most_iterations)

    @property
    def least(self) -> int:
        """Smallest cap: a start scene is used whole, whereas of points a cap selects some."""
        return 0 if self.options.scene is None else self.facts.points

    @property
    def by_time(self) -> bool:
        """Whether the plan chooses the iterations."""
        return self.limits.seconds is not None and "iterations" not in self.given

    def config(self, iterations: int, factor: float, cap: int | None) -> TrainConfig:
        """Return the recipe for a number of iterations, with a cap that fits the memory and the planned time.

        Args:
            iterations: Number of iterations, of which whole batches count.
            factor: Downscaling factor of the photos.
            cap: Number of Gaussians that fit into memory; None for no limit.
        """
        config = self.options.config
        if "iterations" not in self.given:
            config = with_iterations(config, iterations, self.given, rescale=self.rescale)
        if "max_gaussians" in self.given:
            return config
        caps = [] if cap is None else [max(easily_read(cap), self.least)]
        caps += self.device_caps(config, factor)
        if config.strategy in ("mcmc", "fast") or (self.by_time and config.strategy == "adc"):
            facts = self.facts.smaller(factor)
            wanted = facts.wanted(config)
            guarded = config.strategy == "adc"
            caps.append(easily_read(math.ceil(GUARD * wanted)) if guarded else max(wanted, self.least))
        return dataclasses.replace(config, max_gaussians=min(caps) if caps else None)

    def wanted(self, config: TrainConfig, factor: float) -> int:
        """Return the Gaussians that a run plans, or for adc may be expected to reach, without regard to memory."""
        facts = self.facts.smaller(factor)
        wanted = facts.wanted(config)
        return math.ceil(GUARD * wanted) if config.strategy == "adc" else wanted

    def device_caps(self, config: TrainConfig, factor: float) -> list[int]:
        """Return the cap that the device's buffers need, if the run would grow beyond it."""
        most = self.most_on_device
        grows = config.strategy != "none" and most is not None
        return (
            [easily_read(most)] if grows and most is not None and most < self.wanted(config, factor) else []
        )

"""Limits of time: a number of seconds, and the clock that counts them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

Clock = Callable[[], float]
"""Returns the seconds since the work began."""


def stopwatch(elapsed: float = 0.0) -> Clock:
    """Return a clock that runs from now on.

    Args:
        elapsed: Seconds that it shows now, for work that began earlier.
    """
    began = time.perf_counter() - elapsed
    return lambda: time.perf_counter() - began


@dataclass(frozen=True)
class Deadline:
    """A limit of time.

    Args:
        seconds: How long the work may take, from the moment at which the clock showed 0.
        clock: The seconds since the work began; by default they are counted from here on.
    """

    seconds: float
    clock: Clock = field(default_factory=stopwatch, compare=False)

    @property
    def spent(self) -> float:
        """Seconds since the work began."""
        return self.clock()

    @property
    def left(self) -> float:
        """Seconds until the limit; below zero once it has passed."""
        return self.seconds - self.clock()

"""Time limits: a number of seconds, and the clock that counts them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

Clock = Callable[[], float]
"""Returns the seconds since the work began."""


def stopwatch(elapsed: float = 0.0) -> Clock:
    """Return a clock that starts now.

    Args:
        elapsed: Its initial reading in seconds, for work that began earlier.
    """
    began = time.perf_counter() - elapsed
    return lambda: time.perf_counter() - began


@dataclass(frozen=True)
class Deadline:
    """A time limit.

    Args:
        seconds: The limit, counted from the clock's zero.
        clock: Returns the seconds since the work began; by default it starts now.
    """

    seconds: float
    clock: Clock = field(default_factory=stopwatch, compare=False)

    @property
    def spent(self) -> float:
        """Seconds since the work began."""
        return self.clock()

    @property
    def left(self) -> float:
        """Seconds until the limit; negative once it has passed."""
        return self.seconds - self.clock()

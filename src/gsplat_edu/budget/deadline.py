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


TRIAL_SHARE = 0.25
"""Share of the time left until a limit that one kind of trials may take: of refinements, or of lengths."""

PACED_STEPS = 30
"""Steps of the trials after which their whole time is forecast."""


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


class TrialTime:
    """The part of a time limit that trials may take. It counts from when the object is made.

    Trials may take `TRIAL_SHARE` of the time that is left, and never the time that the shortest training needs.

    Args:
        deadline: The limit.
        reserve: Seconds that the shortest training needs afterwards.
    """

    def __init__(self, deadline: Deadline, reserve: float = 0.0) -> None:
        self._deadline = deadline
        self._first: tuple[int, float] | None = None
        self.seconds = max(min(TRIAL_SHARE * deadline.left, deadline.left - reserve), 0.0)
        """The allowed seconds."""
        self._latest = deadline.spent + self.seconds

    def is_over(self, done: int = 0, planned: int = 0) -> bool:
        """Return whether trials have to end: the time is over, or their pace says that it will not suffice.

        Args:
            done: Steps of the trials so far.
            planned: Steps of all of them, as far as it is known; 0 to make no forecast.
        """
        now = self._deadline.spent
        if self._first is None:  # what came before the first step is not repeated
            self._first = (done, now)
        steps = done - self._first[0]
        each = (now - self._first[1]) / steps if steps >= PACED_STEPS else 0.0
        return self.seconds == 0.0 or now + each * max(planned - done, 0) > self._latest

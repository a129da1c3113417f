"""What takes the place of torch's CUDA events and streams on a CPU, where an operation has ended when its call returns.

An event records the time of the monotonic clock. Waiting returns at once, and every stream is idle.
"""

from __future__ import annotations

import time
from typing import Any

from gsplat_edu.base.errors import ArgumentError


class Event:
    """The interface of `torch.cuda.Event`.

    Args:
        enable_timing: Whether `elapsed_time` may read it, as in torch.
        unused: No effect; torch's `blocking`, `interprocess` and `external`.
    """

    def __init__(self, enable_timing: bool = False, *unused: object, **named: object) -> None:
        self._timed = enable_timing
        self._at: float | None = None

    def record(self, stream: object = None) -> None:
        """Record the time now."""
        self._at = time.perf_counter()

    def elapsed_time(self, end_event: Event) -> float:
        """Return the time from this event to another, ms.

        Raises:
            ArgumentError: one of the two was made without enable_timing=True, or has not been recorded.
        """
        times = []
        for name, event in (("the start", self), ("the end", end_event)):
            if not event._timed or event._at is None:
                remedy = "call record() first" if event._timed else "make it with enable_timing=True"
                raise ArgumentError(f"elapsed_time: {name} has no time; {remedy}")
            times.append(event._at)
        return 1000.0 * (times[1] - times[0])

    def query(self) -> bool:
        """Return True: what was called before has ended."""
        return True

    def synchronize(self) -> None:
        """Return at once."""

    def wait(self, stream: object = None) -> None:
        """Return at once."""


class Stream:
    """The interface of `torch.cuda.Stream`; device and priority have no effect."""

    def __init__(self, *unused: object, **named: object) -> None:
        pass

    def record_event(self, event: Event | None = None) -> Event:
        """Record an event, a new one if none is given, and return it."""
        event = Event() if event is None else event
        event.record()
        return event

    def query(self) -> bool:
        """Return True: the stream is idle."""
        return True

    def synchronize(self) -> None:
        """Return at once."""

    def wait_event(self, event: Event) -> None:
        """Return at once."""

    def wait_stream(self, stream: Any) -> None:  # noqa: ANN401
        """Return at once."""


CURRENT = Stream()
"""What `torch.cuda.current_stream` and `default_stream` return."""

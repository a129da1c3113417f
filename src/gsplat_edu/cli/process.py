"""This process: its age, because a time limit counts from the start of the command, and the signals that end it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from gsplat_edu.base.text import Told


def process_age() -> float:
    """Return the seconds since this process began; if the system cannot tell, since Python's clock began."""
    try:
        fields = Path("/proc/self/stat").read_text("ascii", errors="replace").rpartition(")")[2].split()
        up = float(Path("/proc/uptime").read_text("ascii").split()[0])
        return max(up - int(fields[19]) / os.sysconf("SC_CLK_TCK"), 0.0)
    except (OSError, ValueError, IndexError):
        return time.process_time()


@contextmanager
def interruptible(patient: bool = False) -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C and SIGTERM end a training between two iterations; a second signal ends it at once.

    Args:
        patient: Ignore a second signal: torchrun sends one after that of the terminal.

    Yields:
        A function that returns whether a signal arrived. A loop that polls it should end soon after.
    """
    came = False

    def note(number: int, frame: object) -> None:
        nonlocal came
        if came and not patient:
            raise KeyboardInterrupt(
                Told(
                    "interrupted; saved checkpoints are intact, --resume continues from the last one",
                    "stopped at once; it can be continued from its last saved state",
                )
            )
        came = True

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            # None stands for a handler that Python did not install and cannot put back
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

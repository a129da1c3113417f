"""Identify processes that outlive their parent, and send them signals."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from pathlib import Path

PROC = Path("/proc")
"""Where Linux lists processes; other systems have `ps`."""


def identity(pid: int) -> str | None:
    """Return a value that distinguishes a process from later ones with its number, such as its start time.

    Args:
        pid: Process id.

    Returns:
        None if no such process runs; one that has ended but was not waited for does not run.
    """
    if PROC.is_dir():
        try:
            fields = (PROC / f"{pid}/stat").read_text("utf-8", errors="replace").rpartition(")")[2].split()
            boot = (PROC / "sys/kernel/random/boot_id").read_text("ascii").strip()
        except (OSError, ValueError):
            return None
        return None if fields[0] in "ZX" else f"{boot} {fields[19]}"
    done = subprocess.run(
        ["ps", "-o", "stat=,lstart=", "-p", str(pid)], capture_output=True, text=True, check=False
    )
    state, _, start = done.stdout.strip().partition(" ")
    return start.strip() if start and not state.startswith("Z") else None


def is_running(pid: int, known: str) -> bool:
    """Return whether a process still runs.

    Args:
        pid: Process id.
        known: Its `identity` when it was started.
    """
    return pid > 1 and bool(known) and identity(pid) == known


def carries(pid: int, variable: str, value: str) -> bool:
    """Return whether a process was started with a variable in its environment.

    Args:
        pid: Process id.
        variable: Name of the variable.
        value: Its value.
    """
    entry = os.fsencode(f"{variable}={value}")
    if PROC.is_dir():
        try:
            return entry in (PROC / f"{pid}/environ").read_bytes().split(b"\0")
        except OSError:
            return False
    words = ["ps", "eww", "-o", "command=", "-p", str(pid)]
    done = subprocess.run(words, capture_output=True, check=False)
    return entry in done.stdout


def send(pid: int, known: str, number: int, *, group: bool = False) -> bool:
    """Send a signal, unless the process has ended and another one has its number.

    Args:
        pid: Process id.
        known: Its `identity` when it was started.
        number: The signal.
        group: Whether its whole process group gets the signal; the process has to lead it.

    Returns:
        Whether the signal was sent.
    """
    if not is_running(pid, known):
        return False
    with contextlib.suppress(ProcessLookupError):
        if group and os.getpgid(pid) == pid:
            os.killpg(pid, number)
        else:
            os.kill(pid, number)
        return True
    return False


# Windows has no SIGKILL. No jobs run there, but every command imports this module.
SIGNALS = {
    "interrupt": signal.SIGINT,
    "terminate": signal.SIGTERM,
    "kill": getattr(signal, "SIGKILL", signal.SIGTERM),
}
"""The signals of a cancellation, in their order."""

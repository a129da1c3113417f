"""Memory still available to this process; work that needs more is rejected before it starts.

Linux grants memory that it does not have and later kills the process that uses it. So large allocations of known size
are compared with the free memory first.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

from gsplat_edu.base.errors import NotEnoughMemoryError

WORTH_ASKING = 64 * 2**20
"""Smaller requests are granted without a query, which takes about 0.1 ms."""

PROC, CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")

UNLIMITED = 2**60
"""A limit of at least this number of bytes counts as no limit."""

_SHORTAGES = (
    "can't allocate memory",
    "cannot allocate memory",
    "not enough memory",
    "out of memory",
    "can't start new thread",
)
"""Lower-case phrases by which RuntimeErrors of torch and of Python's threads report insufficient memory."""


def available_memory() -> int | None:
    """Return the bytes this process can still use: the minimum over the machine, its cgroups and its limits.

    Returns:
        None if the system does not provide the information.
    """
    found = [*_machine(), *_cgroups(), *_address_space()]
    return max(0, min(found)) if found else None


def require_memory(what: str, nbytes: int, advice: str) -> None:
    """Reject work that needs more memory than is free.

    Args:
        what: The work, as the subject of the message.
        nbytes: Its peak memory in bytes.
        advice: Advice for the message.

    Raises:
        NotEnoughMemoryError: fewer bytes are available.
    """
    if nbytes < WORTH_ASKING:
        return
    available = available_memory()
    if available is not None and nbytes > available:
        raise NotEnoughMemoryError(
            f"{what}: needs {_gib(nbytes)} of memory, but only {_gib(available)} are free; {advice}"
        )


def shortage(error: BaseException) -> str | None:
    """Return the message of an error caused by insufficient memory; None for other errors.

    Covers Python, NumPy and the native kernels (MemoryError), torch and threads (RuntimeError), OpenCV and the system.
    """
    said = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return said or type(error).__name__
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return said
    if getattr(error, "code", None) == -4 and type(error).__module__.startswith("cv2"):  # StsNoMem
        return said
    if isinstance(error, RuntimeError) and any(words in said.lower() for words in _SHORTAGES):
        return said
    return None


def _gib(nbytes: int) -> str:
    return f"{nbytes / 2**30:,.2f} GiB"


def _machine() -> list[int]:
    for line in _lines(PROC / "meminfo"):
        if line.startswith("MemAvailable:"):
            return _numbers(line.split()[1], 1024)
    return []


def _cgroups() -> list[int]:
    """Return the free memory of each enclosing cgroup; its file cache counts as free."""
    found = []
    for line in _lines(PROC / "self" / "cgroup"):
        _, controllers, place = [*line.split(":", 2), "", "/"][:3]
        if controllers == "":
            top, most, used, cache = CGROUPS, "memory.max", "memory.current", ("inactive_file", "active_file")
        elif "memory" in controllers.split(","):
            top, most, used = CGROUPS / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"
            cache = ("total_inactive_file", "total_active_file")
        else:
            continue
        folder = top / place.lstrip("/")
        for here in (folder, *folder.parents):
            limits, usages = (_numbers("".join(_lines(here / name)).strip()) for name in (most, used))
            if limits and usages and limits[0] < UNLIMITED:
                stat = dict(line.split(maxsplit=1) for line in _lines(here / "memory.stat") if " " in line)
                free = sum(sum(_numbers(stat.get(name, "").strip())) for name in cache)
                found.append(limits[0] - usages[0] + free)
            if here == top:
                break
    return found


def _address_space() -> list[int]:
    try:
        import resource
    except ImportError:  # Windows
        return []
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if soft == resource.RLIM_INFINITY or soft >= UNLIMITED:
        return []
    pages = "".join(_lines(PROC / "self" / "statm")).split()[:1]
    return [soft - n for n in _numbers(pages[0], os.sysconf("SC_PAGE_SIZE"))] if pages else []


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text("ascii", errors="replace").splitlines()
    except OSError:
        return []


def _numbers(text: str, unit: int = 1) -> list[int]:
    return [unit * int(text)] if text.isdecimal() else []

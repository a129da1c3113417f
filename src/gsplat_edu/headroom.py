"""How much memory this process can still take; work that needs more is refused before it starts.

Linux grants memory that it does not have and later kills the process that touches it. So a photo, an image or a list
whose size is known is compared with what is free first.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

from gsplat_edu.errors import NotEnoughMemoryError

WORTH_ASKING = 64 * 2**20
"""Smaller needs are granted without asking the system, which takes some 0.1 ms."""

PROC, CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")

UNLIMITED = 2**60
"""Limits of this many bytes and more count as none."""

_SHORTAGES = (
    "can't allocate memory",
    "cannot allocate memory",
    "not enough memory",
    "out of memory",
    "can't start new thread",
)
"""What RuntimeErrors of torch and Python's threads say when memory ran out, in lower case."""


def available_memory() -> int | None:
    """Return the bytes this process can still take: the least that the machine, its cgroups and its limits leave.

    Returns:
        None where the system does not say.
    """
    found = [*_machine(), *_cgroups(), *_address_space()]
    return max(0, min(found)) if found else None


def require_memory(what: str, nbytes: int, advice: str) -> None:
    """Refuse work that needs more memory than there is.

    Args:
        what: The work, as the subject of the message.
        nbytes: Bytes it takes at its peak.
        advice: What to do, for the message.

    Raises:
        NotEnoughMemoryError: fewer bytes are available.
    """
    if nbytes < WORTH_ASKING:
        return
    available = available_memory()
    if available is not None and nbytes > available:
        raise NotEnoughMemoryError(
            f"{what}: needs {_gib(nbytes)} of memory, but {_gib(available)} are free; {advice}"
        )


def shortage(error: BaseException) -> str | None:
    """Return what an error says if memory ran out; None if it is about something else.

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
    """Return what each cgroup above this process leaves; pages of its file cache count as free."""
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

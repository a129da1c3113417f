"""The adapters of this computer: which there are, which one is used, and why none can be."""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from gsplat_edu.base.text import first_line
from gsplat_edu.engine.llvm import load_triton

INSTALL = 'pip install "gsplat-edu[gpu]"'
"""Installs wgpu."""

ADAPTER_VARIABLE = "GSPLAT_EDU_ADAPTER"
"""Environment variable with a part of the name of the adapter to use."""

KINDS = ("DiscreteGPU", "IntegratedGPU", "VirtualGPU", "Unknown", "CPU")
"""Kinds of adapters, best first."""


@dataclass(frozen=True)
class AdapterName:
    """An adapter as it is listed.

    Args:
        name: Its device's name.
        kind: One of `KINDS`.
        interface: "Vulkan", "Metal" or "D3D12".
        driver: The driver's description of itself.
    """

    name: str
    kind: str
    interface: str
    driver: str

    @property
    def software(self) -> bool:
        """Whether it computes on the CPU."""
        return self.kind == "CPU"


def why_unavailable() -> str | None:
    """Return why no adapter can be used here; None if one can."""
    if importlib.util.find_spec("wgpu") is None:
        return f"wgpu is not installed; {INSTALL}, or use the backend cpu"
    try:
        found = adapters()
    except Exception as error:  # a driver's library that does not load raises anything
        return f"wgpu does not start here ({first_line(error)}); use the backend cpu"
    wanted = os.environ.get(ADAPTER_VARIABLE, "")
    if not found:
        return (
            "wgpu finds no adapter for Vulkan, Metal or DirectX 12; install the driver of the GPU, or on Debian and "
            "Ubuntu mesa-vulkan-drivers, which computes on the CPU, or use the backend cpu"
        )
    if not any(wanted.lower() in name.name.lower() for name in found):
        names = ", ".join(name.name for name in found)
        return f"{ADAPTER_VARIABLE}: is {wanted!r}, which no adapter's name contains; there are: {names}"
    return None


def adapters() -> tuple[AdapterName, ...]:
    """List the adapters, best first; OpenGL's, which repeat them, are left out."""
    return tuple(name for name, _ in listed_adapters())


def chosen_adapter() -> AdapterName:
    """Return the best adapter, or the first whose name contains `GSPLAT_EDU_ADAPTER`; call `why_unavailable` before."""
    wanted = os.environ.get(ADAPTER_VARIABLE, "").lower()
    return next(name for name in adapters() if wanted in name.name.lower())


@dataclass(frozen=True)
class Listing:
    """The adapters of this computer, or why none can be used.

    Args:
        adapters: Best first.
        reason: As `why_unavailable`; None if there is a usable one.
    """

    adapters: tuple[AdapterName, ...]
    reason: str | None


LISTING_SECONDS = 60.0
"""Time for another process to list the adapters."""


@functools.cache
def listed_outside() -> Listing:
    """List the adapters by another process.

    A driver that is loaded stays: Mesa's software adapter takes 150 MiB of a process that then uses another backend.
    """
    if importlib.util.find_spec("wgpu") is None:
        return Listing((), why_unavailable())
    command = [sys.executable, "-m", "gsplat_edu.engine.adapters"]
    try:
        done = subprocess.run(command, capture_output=True, timeout=LISTING_SECONDS, check=True)
        found = json.loads(done.stdout)
        return Listing(tuple(AdapterName(**one) for one in found["adapters"]), found["reason"])
    except (OSError, ValueError, KeyError, TypeError, subprocess.SubprocessError) as error:
        return Listing((), f"listing the adapters fails ({first_line(error)}); use the backend cpu")


def _print_listing() -> None:
    reason = why_unavailable()
    found = adapters() if reason is None else ()
    print(json.dumps({"adapters": [asdict(one) for one in found], "reason": reason}))


@contextmanager
def _runtime_folder() -> Iterator[None]:
    """Name a folder in XDG_RUNTIME_DIR if it is unset: Mesa prints errors without it, though we open no window."""
    if "XDG_RUNTIME_DIR" in os.environ:
        yield
        return
    os.environ["XDG_RUNTIME_DIR"] = tempfile.gettempdir()
    try:
        yield
    finally:
        del os.environ["XDG_RUNTIME_DIR"]


@functools.cache
def listed_adapters() -> tuple[tuple[AdapterName, Any], ...]:
    """Return names and wgpu's objects of the adapters, best first."""
    import wgpu

    load_triton()
    found = []
    with _runtime_folder():
        listed = wgpu.gpu.enumerate_adapters_sync()
    for adapter in listed:
        info = adapter.info
        name = AdapterName(info["device"], info["adapter_type"], info["backend_type"], info["description"])
        if name.interface != "OpenGL":
            found.append((name, adapter))
    return tuple(
        sorted(found, key=lambda pair: KINDS.index(pair[0].kind) if pair[0].kind in KINDS else len(KINDS))
    )


if __name__ == "__main__":
    _print_listing()

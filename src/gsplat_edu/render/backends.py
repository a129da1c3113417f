"""The rendering backends of this machine, and the reasons why others are unavailable. No silent fallbacks."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Mapping

import torch

from gsplat_edu.base.errors import BackendUnavailableError, BackendWarning
from gsplat_edu.render.backend import Backend, BackendRoom
from gsplat_edu.render.cpu import backend as cpu
from gsplat_edu.render.cuda import backend as cuda
from gsplat_edu.render.settings import BACKENDS as BACKENDS, check_backend
from gsplat_edu.render.torch import backend as dense
from gsplat_edu.render.webgpu import backend as webgpu

ROOMS: Mapping[str, BackendRoom] = {"cpu": cpu, "torch": dense, "cuda": cuda, "webgpu": webgpu}
"""The room of each backend, by its name in `BACKENDS`."""


def resolve_backend(name: str, device: torch.device | None = None) -> str:
    """Resolve a backend's name, or "auto", to the backend that will run.

    The first use of cuda or webgpu checks its kernels on the device (`gsplat_edu.render.self_check`).

    Args:
        name: "auto" selects cuda if torch sees a GPU whose kernels pass the check, else cpu; or a backend by name. For
            a training, `gsplat_edu.budget.choice` may choose webgpu instead of cpu.
        device: The device of the tensors to render, if they exist already: "auto" does not move them.

    Returns:
        The name of an available backend.

    Raises:
        BackendUnavailableError: the backend does not exist or cannot run here; the message says why.

    Warns:
        BackendWarning: "auto" selects cpu although there is a GPU, because its kernels fail the check.
    """
    check_backend(name)
    if name == "auto":
        on_gpu = torch.cuda.is_available() if device is None else device.type == "cuda"
        name = "cuda" if on_gpu and not cuda.interpreted() else "cpu"
        if name == "cuda" and device is None and (reason := unavailable("cuda")):
            warn_once(f"the GPU is not used: {reason}")
            name = "cpu"
    reason = unavailable(name, device)
    if reason:
        raise BackendUnavailableError(f"backend {name!r}: {reason}")
    return name


@functools.cache
def warn_once(message: str) -> None:
    """Warn of what every use of a backend would say, the first time that it is said."""
    warnings.warn(message, BackendWarning, stacklevel=3)


def unavailable(name: str, device: torch.device | None = None) -> str | None:
    """Return why a backend cannot run on this machine; None if it can.

    Args:
        name: The backend.
        device: The GPU for cuda; None means the current one.
    """
    return ROOMS[name].why_unavailable(_host, device)


def gpu_of(backend: str) -> str | None:
    """Return the name of the GPU on which an available backend runs, and its interface; None on the processor."""
    return ROOMS[backend].gpu()


def device_of(backend: str) -> torch.device:
    """Return the device on which a backend needs its tensors."""
    return ROOMS[backend].device()


def load_backend(name: str = "auto", device: torch.device | None = None) -> Backend:
    """Return a backend's kernels.

    Args:
        name: "auto", or a backend by name; see `resolve_backend`.
        device: The device of the tensors, if they exist already.

    Raises:
        BackendUnavailableError: the backend does not exist or cannot run here; the message says why.
    """
    return ROOMS[resolve_backend(name, device)].make(_host)


def _host() -> Backend:
    """Return the kernels for tensors on the processor: native ones, or torch's where the native module is missing."""
    room: BackendRoom = cpu if cpu.why_unavailable(_host) is None else dense
    return room.make(_host)

"""The rendering backends of this machine, and the reasons why others are unavailable. No silent fallbacks."""

from __future__ import annotations

import functools
import importlib.util
import os
import warnings

import torch

from gsplat_edu import kernels
from gsplat_edu.errors import BackendUnavailableError, BackendWarning
from gsplat_edu.render.self_check import cuda_failure
from gsplat_edu.render.settings import BACKENDS as BACKENDS
from gsplat_edu.render.settings import check_backend


def resolve_backend(name: str, device: torch.device | None = None) -> str:
    """Resolve a backend's name, or "auto", to the backend that will run.

    The first use of cuda in a process checks its kernels on the device (`gsplat_edu.render.self_check`).

    Args:
        name: "auto" selects cuda if torch sees a GPU whose kernels pass the check, else cpu; or a backend by name.
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
        name = "cuda" if on_gpu and not interpreted() else "cpu"
        if name == "cuda" and device is None and (reason := unavailable("cuda")):
            _warn_once(f"the GPU is not used: {reason}")
            name = "cpu"
    reason = unavailable(name, device)
    if reason:
        raise BackendUnavailableError(f"backend {name!r}: {reason}")
    return name


@functools.cache
def _warn_once(message: str) -> None:
    warnings.warn(message, BackendWarning, stacklevel=3)


def unavailable(name: str, device: torch.device | None = None) -> str | None:
    """Return why a backend cannot run on this machine; None if it can.

    Args:
        name: The backend.
        device: The GPU for cuda; None means the current one.
    """
    if name == "cpu":
        return kernels.REASON
    if name == "cuda":
        if importlib.util.find_spec("triton") is None:
            return "triton is not installed; pip install triton, or use the backend cpu"
        if interpreted():
            return None
        if not torch.cuda.is_available():
            return "torch sees no GPU; use the backend cpu (TRITON_INTERPRET=1 runs the kernels, slowly, without one)"
        if failure := cuda_failure(device if device is not None and device.type == "cuda" else None):
            return f"its kernels failed their check on this GPU: {failure}; the backend cpu needs no GPU"
    return None


def interpreted() -> bool:
    """Return whether Triton's kernels run in its interpreter, on CPU tensors, for tests without a GPU."""
    return os.environ.get("TRITON_INTERPRET", "0").lower() in ("1", "true", "on", "yes", "y")


def device_of(backend: str) -> torch.device:
    """Return the device on which a backend needs its tensors."""
    return torch.device("cuda" if backend == "cuda" and torch.cuda.is_available() else "cpu")

"""Which rendering backends this machine has, and why not the others. Nothing falls back in silence."""

from __future__ import annotations

import importlib.util
import os

import torch

from gsplat_edu import kernels
from gsplat_edu.errors import BackendUnavailableError
from gsplat_edu.render.settings import BACKENDS as BACKENDS
from gsplat_edu.render.settings import check_backend


def resolve_backend(name: str, device: torch.device | None = None) -> str:
    """Turn a backend's name, or "auto", into the backend that will run.

    Args:
        name: "auto" for the GPU's where torch sees one, else the CPU's; or a backend by name.
        device: Where the tensors are that are to be rendered, if they are anywhere yet: "auto" does not move them.

    Returns:
        The name of an available backend.

    Raises:
        BackendUnavailableError: there is no such backend, or it does not run here; the message says why.
    """
    if name == "auto":
        on_gpu = torch.cuda.is_available() if device is None else device.type == "cuda"
        name = "cuda" if on_gpu and not interpreted() else "cpu"
    check_backend(name)
    reason = unavailable(name)
    if reason:
        raise BackendUnavailableError(f"backend {name!r}: {reason}")
    return name


def unavailable(name: str) -> str | None:
    """Say why a backend does not run on this machine; None where it does."""
    if name == "cpu":
        return kernels.REASON
    if name == "cuda":
        if importlib.util.find_spec("triton") is None:
            return "triton is not installed; pip install triton, or use the backend cpu"
        if not torch.cuda.is_available() and not interpreted():
            return "torch sees no GPU; use the backend cpu (TRITON_INTERPRET=1 runs the kernels, slowly, without one)"
    return None


def interpreted() -> bool:
    """Say whether Triton's kernels run in its interpreter, on CPU tensors, to be tested without a GPU."""
    return os.environ.get("TRITON_INTERPRET", "0").lower() in ("1", "true", "on", "yes", "y")


def device_of(backend: str) -> torch.device:
    """Return where a backend wants its tensors."""
    return torch.device("cuda" if backend == "cuda" and torch.cuda.is_available() else "cpu")

"""Which rendering backends this machine has, and why not the others. Nothing falls back in silence."""

from __future__ import annotations

from gsplat_edu import kernels
from gsplat_edu.errors import BackendUnavailableError

BACKENDS = ("cpu", "torch")
"""All backends, the fastest first: native SIMD kernels; the dense reference, every splat at every pixel."""


def resolve_backend(name: str) -> str:
    """Turn a backend's name, or "auto", into the backend that will run.

    Args:
        name: "auto" for the fastest there is, or a backend by name.

    Returns:
        The name of an available backend.

    Raises:
        BackendUnavailableError: there is no such backend, or it does not run here; the message says why.
    """
    if name == "auto":
        name = BACKENDS[0]
    if name not in BACKENDS:
        raise BackendUnavailableError(
            f"backend {name!r}: not in this version of gsplat_edu; use auto or one of: {', '.join(BACKENDS)}"
        )
    reason = unavailable(name)
    if reason:
        raise BackendUnavailableError(f"backend {name!r}: {reason}")
    return name


def unavailable(name: str) -> str | None:
    """Say why a backend does not run on this machine; None where it does."""
    return kernels.REASON if name == "cpu" else None

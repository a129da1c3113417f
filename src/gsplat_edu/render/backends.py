"""Which rendering backends this machine has, and why not the others. Nothing falls back in silence."""

from __future__ import annotations

from gsplat_edu.errors import BackendUnavailableError

AVAILABLE = ("torch",)
"""Backends that run on every machine: torch is the dense reference, every splat at every pixel."""


def resolve_backend(name: str) -> str:
    """Turn a backend's name, or "auto", into the backend that will run.

    Args:
        name: "auto" for the fastest there is, or a backend by name.

    Returns:
        The name of an available backend.

    Raises:
        BackendUnavailableError: no such backend here; the message lists those there are.
    """
    if name == "auto":
        return AVAILABLE[0]
    if name not in AVAILABLE:
        raise BackendUnavailableError(
            f"backend {name!r}: not in this version of gsplat_edu; use auto or one of: {', '.join(AVAILABLE)}"
        )
    return name

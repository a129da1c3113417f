"""The native module, or the reason why it is not there. Every call of a native kernel goes through here.

Chapter: 10_the_naive_kernel.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils.dlpack import to_dlpack  # type: ignore[attr-defined]

from gsplat_edu.errors import BackendUnavailableError
from gsplat_edu.headroom import available_memory

_native: ModuleType | None
REASON: str | None
"""Why the native module does not load, and what to do; None where it does."""

try:
    _native = importlib.import_module("gsplat_edu._native")
except ImportError as error:
    _native = None
    mend = "unset it" if "GSPLAT_EDU_ISA" in str(error) else "install gsplat_edu again"
    REASON = f"the native module does not load ({error}); {mend}, or use the backend torch"
else:
    REASON = None
    _native.ask_before_large_blocks(available_memory)

SUFFIXES = {torch.float32: "32", torch.float64: "64"}
"""How native names end by scalar type: float for speed, double for proof."""


def array(tensor: Tensor) -> object:
    """Hand a tensor to the native module, which checks it.

    The module is built against no torch. Tensors describe themselves to it through DLPack's C interface, at next to no
    cost; those of older versions of torch, which lack it, become DLPack capsules.
    """
    return tensor if _DESCRIBE_THEMSELVES else to_dlpack(tensor)


_DESCRIBE_THEMSELVES = hasattr(torch.Tensor, "__dlpack_c_exchange_api__")


def native() -> Any:  # noqa: ANN401
    """Return the native module, for its structures: Camera, Settings, Scene, Gradients and Images.

    Raises:
        BackendUnavailableError: it is not there.
    """
    if _native is None:
        raise BackendUnavailableError(f"native kernels: {REASON}")
    return _native


def kernel(name: str, dtype: torch.dtype) -> Any:  # noqa: ANN401
    """Look up a native function or class by its name without the scalar type, "adam_f" for example.

    Raises:
        BackendUnavailableError: the native module is not there.
    """
    return getattr(native(), name + SUFFIXES[dtype])

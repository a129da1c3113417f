"""Access to the native module, or the reason why it is missing. Every native kernel is called through this module.

Chapter: 10_the_naive_kernel.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils.dlpack import to_dlpack  # type: ignore[attr-defined]  # documented, but not in its __all__

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.base.headroom import available_memory

_native: ModuleType | None
REASON: str | None
"""Why the native module does not load, and what to do; None if it is loaded."""

try:
    _native = importlib.import_module("gsplat_edu._native")
except ImportError as error:
    _native = None
    remedy = "unset it" if "GSPLAT_EDU_ISA" in str(error) else "install gsplat_edu again"
    slow = "the backend torch, whose dense renders take hundreds of times as long"
    REASON = f"the native module does not load ({error}); {remedy}, or use {slow}"
else:
    REASON = None
    _native.ask_before_large_blocks(available_memory)

SUFFIXES = {torch.float32: "32", torch.float64: "64"}
"""Suffixes of native names by scalar type: float for speed, double for gradient checks."""


def native_array(tensor: Tensor) -> object:
    """Pass a tensor to the native module, which validates it.

    The module is not built against torch. It reads tensors through DLPack's C interface at almost no cost; tensors of
    older torch versions, which lack it, are converted to DLPack capsules.
    """
    return tensor if DESCRIBE_THEMSELVES else to_dlpack(tensor)


DESCRIBE_THEMSELVES = hasattr(torch.Tensor, "__dlpack_c_exchange_api__")
"""Whether tensors of this version of torch have DLPack's C interface."""


def native() -> Any:  # noqa: ANN401
    """Return the native module, for its structures: Camera, Settings, Scene, Gradients and Images.

    Raises:
        BackendUnavailableError: the native module is missing.
    """
    if _native is None:
        raise BackendUnavailableError(f"native kernels: {REASON}")
    return _native


def kernel(name: str, dtype: torch.dtype) -> Any:  # noqa: ANN401
    """Look up a native function or class by its name without the scalar type, for example "adam_f".

    Raises:
        BackendUnavailableError: the native module is missing.
    """
    return getattr(native(), name + SUFFIXES[dtype])

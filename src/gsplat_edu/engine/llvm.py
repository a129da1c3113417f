"""Two libraries of LLVM in one process: Triton's has to be loaded before that of Mesa's software adapter."""

from __future__ import annotations

import contextlib
import importlib


def load_triton() -> None:
    """Load Triton if it is installed; call it before wgpu loads a driver.

    Loaded after Mesa's llvmpipe, Triton ends the process with a segmentation fault, and torch imports it by itself, in
    `torch.optim` for instance.
    """
    with contextlib.suppress(ImportError):
        importlib.import_module("triton")

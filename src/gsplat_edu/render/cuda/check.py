"""The check of the backend cuda on a device before its first use; see `gsplat_edu.render.self_check`."""

from __future__ import annotations

import functools
from importlib.metadata import version
from pathlib import Path

import torch

from gsplat_edu.render.backend import Rasterize
from gsplat_edu.render.self_check import checked_once, does_not_run, hash_of_kernels, render_error


def cuda_failure(exact: Rasterize, device: torch.device | None = None) -> str | None:
    """Describe the failure of the kernels of the backend cuda on a device; None if they pass.

    The result is cached for the process; a pass is stored until device, driver or versions change.

    Args:
        exact: Renders tensors on the CPU in float64.
        device: A CUDA device, the current one if None or without an index; or the CPU, under Triton's interpreter.
    """
    try:
        if device is None or (device.type == "cuda" and device.index is None):
            device = torch.device("cuda", torch.cuda.current_device())
        return _failure(exact, device)
    except Exception as error:  # compilers and drivers raise anything; the CPU renders instead
        return does_not_run(error)


def forget_checks() -> None:
    """Forget the results of this process, such as after a driver was replaced; passes that are stored still count."""
    _failure.cache_clear()


@functools.cache
def _failure(exact: Rasterize, device: torch.device) -> str | None:
    return checked_once("cuda", _identity(device), lambda: kernel_error(exact, device))


def kernel_error(exact: Rasterize, device: torch.device) -> str | None:
    """Compare what Triton's kernels compute on a device with float64 on the CPU.

    Args:
        exact: As for `cuda_failure`.
        device: Likewise.

    Returns:
        The first result that exceeds its bound, and its error; None if none does.
    """
    from gsplat_edu.render.cuda.render import render_triton

    return render_error(render_triton, exact, device)


def _identity(device: torch.device) -> str:
    """Identify everything that a pass depends on: device, driver, compiler, torch, and the source of our kernels."""
    if device.type == "cuda":
        name, capability = torch.cuda.get_device_name(device), torch.cuda.get_device_capability(device)
        on = f"{name}, {capability}, CUDA {torch.version.cuda}, driver {_driver()}"
    else:
        on = "interpreter"
    return f"{on}, torch {torch.__version__}, triton {version('triton')}, kernels {hash_of_kernels()}"


def _driver() -> str:
    """Return the NVIDIA driver's version from its kernel module; "unknown" if it gives none."""
    try:
        return Path("/sys/module/nvidia/version").read_text().strip()
    except OSError:
        return "unknown"

"""The rendering backends of this machine, and the reasons why others are unavailable. No silent fallbacks."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import os
import warnings

import torch
from torch import Tensor

from gsplat_edu.base.errors import BackendUnavailableError, BackendWarning
from gsplat_edu.engine import adapters
from gsplat_edu.engine.room import room_of
from gsplat_edu.ops import kernels
from gsplat_edu.ops.adam import adam_in_torch, adam_natively
from gsplat_edu.ops.losses import l1_ssim, l1_ssim_in_torch
from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.ops.noise import add_noise_in_torch, add_noise_natively
from gsplat_edu.ops.recolor import recolored_in_torch, recolored_natively
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.self_check import cuda_failure, webgpu_failure
from gsplat_edu.render.settings import BACKENDS as BACKENDS, check_backend

CUDA_LACKS = frozenset({"stop", "processes", "statistics"})
"""What the Triton kernels do not offer."""

WEBGPU_LACKS = frozenset({"processes"})
"""What the WGSL kernels do not offer."""


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
        name = "cuda" if on_gpu and not interpreted() else "cpu"
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
    if name == "cpu":
        return kernels.REASON
    if name == "webgpu":
        return adapters.why_unavailable() or _webgpu_failure()
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


def _webgpu_failure() -> str | None:
    if failure := webgpu_failure():
        return f"its kernels failed their check on {adapters.chosen_adapter().name}: {failure}; use the backend cpu"
    return None


def interpreted() -> bool:
    """Return whether Triton's kernels run in its interpreter, on CPU tensors, for tests without a GPU."""
    return os.environ.get("TRITON_INTERPRET", "0").lower() in ("1", "true", "on", "yes", "y")


def gpu_of(backend: str) -> str | None:
    """Return the name of the GPU on which an available backend runs, and its interface; None on the processor."""
    if backend == "webgpu":
        adapter = adapters.chosen_adapter()
        return f"{adapter.name}, {adapter.interface}{', which computes on the processor' * adapter.software}"
    if backend == "cuda":
        return "Triton's interpreter" if interpreted() else f"{torch.cuda.get_device_name()}, CUDA"
    return None


def device_of(backend: str) -> torch.device:
    """Return the device on which a backend needs its tensors."""
    return torch.device("cuda" if backend == "cuda" and torch.cuda.is_available() else "cpu")


def load_backend(name: str = "auto", device: torch.device | None = None) -> Backend:
    """Return a backend's kernels.

    Args:
        name: "auto", or a backend by name; see `resolve_backend`.
        device: The device of the tensors, if they exist already.

    Raises:
        BackendUnavailableError: the backend does not exist or cannot run here; the message says why.
    """
    return _LOADERS[resolve_backend(name, device)]()


@functools.cache
def _cpu() -> Backend:
    from gsplat_edu.render.cpu import render_cpu  # it needs the native module

    return Backend(
        "cpu",
        device_of("cpu"),
        render_cpu,
        l1_ssim,
        adam_natively,
        add_noise_natively,
        recolored_natively,
    )


@functools.cache
def _dense() -> Backend:
    from gsplat_edu.render.torch_reference import render_dense

    return Backend(
        "torch",
        device_of("torch"),
        render_dense,
        l1_ssim_in_torch,
        adam_in_torch,
        add_noise_in_torch,
        recolored_in_torch,
        frozenset({"stop", "processes", "statistics", "forecast"}),
    )


@functools.cache
def _webgpu() -> Backend:
    from gsplat_edu.render.webgpu import device, render_webgpu
    from gsplat_edu.render.webgpu_resident import WebgpuRun

    others = _cpu() if kernels.REASON is None else _dense()  # its tensors are on the CPU
    return dataclasses.replace(
        others,
        name="webgpu",
        rasterize=render_webgpu,
        lacks=WEBGPU_LACKS,
        resident=WebgpuRun,
        room=lambda: room_of(device()),
    )


@functools.cache
def _cuda() -> Backend:
    from gsplat_edu.render.triton.adam import adam_triton
    from gsplat_edu.render.triton.loss import l1_ssim_triton
    from gsplat_edu.render.triton.rasterize import render_triton

    if interpreted():  # on tensors of the CPU, where the other kernels are faster
        return dataclasses.replace(_cpu(), name="cuda", rasterize=render_triton, lacks=CUDA_LACKS)

    def loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        with torch.cuda.device_of(image):  # type: ignore[no-untyped-call]
            return l1_ssim_triton(image, target, ssim_weight)

    def adam(
        parameter: Tensor, first: Tensor, second: Tensor, gradient: Tensor, numbers: AdamNumbers
    ) -> None:
        if (
            parameter.dtype != torch.float32
        ):  # parameters that are not per Gaussian, such as a capture's lenses
            adam_in_torch(parameter, first, second, gradient, numbers)
            return
        with torch.no_grad(), torch.cuda.device_of(parameter):  # type: ignore[no-untyped-call]
            adam_triton(parameter, first, second, gradient, tuple(numbers))

    return Backend(
        "cuda",
        device_of("cuda"),
        render_triton,
        loss,
        adam,
        add_noise_in_torch,
        recolored_in_torch,
        CUDA_LACKS,
    )


_LOADERS = {"cpu": _cpu, "torch": _dense, "cuda": _cuda, "webgpu": _webgpu}

"""What the backend cuda is, and why it may be unavailable."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import os

import torch
from torch import Tensor

from gsplat_edu.ops.adam import adam_in_torch
from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.ops.noise import add_noise_in_torch
from gsplat_edu.ops.recolor import recolored_in_torch
from gsplat_edu.render.backend import PROCESSOR, Backend, Host
from gsplat_edu.render.cuda.check import cuda_failure

LACKS = frozenset({"stop", "processes", "statistics"})
"""What the Triton kernels do not offer."""


def interpreted() -> bool:
    """Return whether Triton's kernels run in its interpreter, on CPU tensors, for tests without a GPU."""
    return os.environ.get("TRITON_INTERPRET", "0").lower() in ("1", "true", "on", "yes", "y")


def why_unavailable(host: Host, device: torch.device | None = None) -> str | None:
    """Return what is missing, or what the kernels' check found on a GPU; None if the backend can run.

    Args:
        host: Renders what the kernels are compared with.
        device: The GPU; None means the current one.
    """
    if importlib.util.find_spec("triton") is None:
        return "triton is not installed; pip install triton, or use the backend cpu"
    if interpreted():
        return None
    if not torch.cuda.is_available():
        return "torch sees no GPU; use the backend cpu (TRITON_INTERPRET=1 runs the kernels, slowly, without one)"
    on_gpu = device if device is not None and device.type == "cuda" else None
    if failure := cuda_failure(host().rasterize, on_gpu):
        return f"its kernels failed their check on this GPU: {failure}; the backend cpu needs no GPU"
    return None


def gpu() -> str | None:
    """Return the GPU's name, or the interpreter's."""
    return "Triton's interpreter" if interpreted() else f"{torch.cuda.get_device_name()}, CUDA"


def device() -> torch.device:
    """Return the GPU; the processor under the interpreter."""
    return torch.device("cuda") if torch.cuda.is_available() else PROCESSOR


@functools.cache
def make(host: Host) -> Backend:
    """Return the backend; under the interpreter, all but its render is the host's."""
    from gsplat_edu.render.cuda.adam import adam_triton
    from gsplat_edu.render.cuda.loss import l1_ssim_triton
    from gsplat_edu.render.cuda.render import render_triton

    if interpreted():  # on tensors of the CPU, where the other kernels are faster
        return dataclasses.replace(host(), name="cuda", rasterize=render_triton, lacks=LACKS)

    def loss(image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        with torch.cuda.device_of(image):  # type: ignore[no-untyped-call]
            return l1_ssim_triton(image, target, ssim_weight)

    def adam(
        parameter: Tensor, first: Tensor, second: Tensor, gradient: Tensor, numbers: AdamNumbers
    ) -> None:
        if parameter.dtype != torch.float32:  # not per Gaussian, such as a capture's lenses
            adam_in_torch(parameter, first, second, gradient, numbers)
            return
        with torch.no_grad(), torch.cuda.device_of(parameter):  # type: ignore[no-untyped-call]
            adam_triton(parameter, first, second, gradient, tuple(numbers))

    return Backend("cuda", device(), render_triton, loss, adam, add_noise_in_torch, recolored_in_torch, LACKS)

"""What the backend cpu is, and why it may be unavailable."""

from __future__ import annotations

import functools

import torch

from gsplat_edu.ops import kernels
from gsplat_edu.ops.adam import adam_natively
from gsplat_edu.ops.losses import l1_ssim
from gsplat_edu.ops.noise import add_noise_natively
from gsplat_edu.ops.recolor import recolored_natively
from gsplat_edu.render.backend import PROCESSOR, Backend, Host


def why_unavailable(host: Host, device: torch.device | None = None) -> str | None:
    """Return why the native module does not load; None if it does."""
    return kernels.REASON


def gpu() -> str | None:
    """Return None: it runs on the processor."""
    return None


def device() -> torch.device:
    """Return the processor."""
    return PROCESSOR


@functools.cache
def make(host: Host) -> Backend:
    """Return the backend."""
    from gsplat_edu.render.cpu.render import render_cpu  # it needs the native module

    return Backend(
        "cpu", PROCESSOR, render_cpu, l1_ssim, adam_natively, add_noise_natively, recolored_natively
    )

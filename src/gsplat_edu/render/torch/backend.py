"""What the backend torch is."""

from __future__ import annotations

import functools

import torch

from gsplat_edu.ops.adam import adam_in_torch
from gsplat_edu.ops.losses import l1_ssim_in_torch
from gsplat_edu.ops.noise import add_noise_in_torch
from gsplat_edu.ops.recolor import recolored_in_torch
from gsplat_edu.render.backend import PROCESSOR, Backend, Host

LACKS = frozenset({"stop", "processes", "statistics", "forecast"})
"""What it does not offer."""


def why_unavailable(host: Host, device: torch.device | None = None) -> str | None:
    """Return None: torch is always there."""
    return None


def gpu() -> str | None:
    """Return None: it runs on the processor unless its tensors lie elsewhere."""
    return None


def device() -> torch.device:
    """Return the processor."""
    return PROCESSOR


@functools.cache
def make(host: Host) -> Backend:
    """Return the backend."""
    from gsplat_edu.render.torch.render import render_dense

    return Backend(
        "torch",
        PROCESSOR,
        render_dense,
        l1_ssim_in_torch,
        adam_in_torch,
        add_noise_in_torch,
        recolored_in_torch,
        LACKS,
    )

"""What the backend webgpu is, and why it may be unavailable."""

from __future__ import annotations

import dataclasses
import functools

import torch

from gsplat_edu.engine import adapters
from gsplat_edu.engine.room import room_of
from gsplat_edu.render.backend import PROCESSOR, Backend, Host
from gsplat_edu.render.webgpu.check import webgpu_failure

LACKS = frozenset({"processes"})
"""What the WGSL kernels do not offer."""


def why_unavailable(host: Host, device: torch.device | None = None) -> str | None:
    """Return why there is no adapter, or what its kernels' check found; None if the backend can run."""
    if reason := adapters.why_unavailable():
        return reason
    if failure := webgpu_failure(host().rasterize):
        name = adapters.chosen_adapter().name
        return f"its kernels failed their check on {name}: {failure}; use the backend cpu"
    return None


def gpu() -> str | None:
    """Return the adapter's name and its interface."""
    adapter = adapters.chosen_adapter()
    return f"{adapter.name}, {adapter.interface}{', which computes on the processor' * adapter.software}"


def device() -> torch.device:
    """Return the processor, where its tensors lie."""
    return PROCESSOR


@functools.cache
def make(host: Host) -> Backend:
    """Return the backend; tensors that it leaves on the processor are the host's."""
    from gsplat_edu.render.webgpu import render
    from gsplat_edu.render.webgpu.resident import WebgpuRun

    return dataclasses.replace(
        host(),
        name="webgpu",
        rasterize=render.render_webgpu,
        lacks=LACKS,
        resident=WebgpuRun,
        room=lambda: room_of(render.device()),
    )

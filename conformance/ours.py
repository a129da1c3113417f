"""gsplat_edu's own backends as functions for the runner; an example for other renderers.

    python conformance/run.py ours:render_cpu ours:gradients_cpu
    python conformance/run.py ours:render_cpu_float32 ours:gradients_cpu_float32 --precision float32
    python conformance/run.py ours:render_torch ours:gradients_torch

    python conformance/run.py ours:render_webgpu ours:gradients_webgpu --precision float32

Backend cuda, without a GPU: `TRITON_INTERPRET=1`, `ours:render_cuda ours:gradients_cuda --precision float32`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of
from gsplat_edu.render.camera_tensors import INTRINSICS, CameraTensors
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import Distortion, Projection

Arrays = dict[str, Any]


class Renderer:
    """One backend in one precision, as the two functions that the runner takes.

    Args:
        backend: "cpu", "torch", "cuda" or "webgpu".
        dtype: Of the Gaussians; cameras are float64.
    """

    def __init__(self, backend: str, dtype: torch.dtype = torch.float64) -> None:
        self.backend, self.dtype = backend, dtype

    def render(self, gaussians: Arrays, camera: Arrays, settings: Arrays) -> Arrays:
        """Return every output that the backend has."""
        out, _ = self._rendered(gaussians, camera, settings, tracked=False)
        return {name: _array(value) for name, value in _outputs(out).items()}

    def gradients(self, gaussians: Arrays, camera: Arrays, settings: Arrays, upstream: Arrays) -> Arrays:
        """Return the gradients of sum(upstream * outputs), over the outputs that the backend has."""
        out, leaves = self._rendered(gaussians, camera, settings, tracked=True)
        values = _outputs(out)
        losses = [
            (values[name] * torch.tensor(weight).to(values[name])).sum()
            for name, weight in upstream.items()
            if name in values
        ]
        torch.stack(losses).sum().backward()
        found = {name: _array(leaf.grad) for name, leaf in leaves.items() if leaf.grad is not None}
        numbers = zip(INTRINSICS, found.pop("intrinsics"), strict=True)
        motion = {"turn": found["motion"][:3], "shift": found.pop("motion")[3:]} if "motion" in found else {}
        return found | motion | {name: np.asarray(number) for name, number in numbers}

    def _rendered(
        self, gaussians: Arrays, camera: Arrays, settings: Arrays, *, tracked: bool
    ) -> tuple[RenderOutput, dict[str, Tensor]]:
        device = device_of(self.backend)
        leaves = {
            name: torch.tensor(array, dtype=self.dtype, device=device, requires_grad=tracked)
            for name, array in (gaussians | {"background": settings["background"]}).items()
        }
        intrinsics = [camera[name] for name in INTRINSICS]
        pose = {"R": camera["R"], "eye": camera["eye"], "intrinsics": np.array(intrinsics)}
        pose |= {"distortion": camera["distortion"]} if np.any(camera["distortion"]) else {}
        lens = Distortion((), camera["radial_first"]) if "distortion" in pose else None
        still = camera["readout"] == "none" and not camera["exposure"]
        pose |= {} if still else {"motion": np.concatenate([camera["turn"], camera["shift"]])}
        leaves |= {name: torch.tensor(array, requires_grad=tracked) for name, array in pose.items()}
        out = render(
            Gaussians(
                means=leaves["means"],
                quats=leaves["quats"],
                log_scales=leaves["log_scales"],
                sh0=leaves["sh"][:, :1],
                sh_rest=leaves["sh"][:, 1:],
                logit_opacities=leaves["logit_opacities"],
            ),
            CameraTensors(
                leaves["R"],
                leaves["eye"],
                leaves["intrinsics"],
                camera["height"],
                camera["width"],
                Projection(camera["projection"], lens),
                leaves.get("distortion"),
                leaves.get("motion"),
                "down" if still else camera["readout"],
                camera["exposure"],
            ),
            settings=RenderSettings(
                sh_degree=settings["sh_degree"],
                antialiased=settings["antialiased"],
                median_depth=True,
                jacobian_limit=settings["jacobian_limit"],
                alpha_max=settings["alpha_max"],
                z_near=settings["z_near"],
            ),
            background=leaves["background"],
            features=leaves["features"],
            backend=self.backend,
        )
        return out, leaves


def _outputs(out: RenderOutput) -> dict[str, Tensor]:
    names = ("image", "transmittance", "alpha", "depth", "median_depth", "features")
    return {name: value for name in names if (value := getattr(out, name)) is not None}


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.numpy(force=True).astype(np.float64)


_float64, _float32 = Renderer("cpu"), Renderer("cpu", torch.float32)
render_cpu, gradients_cpu = _float64.render, _float64.gradients
render_cpu_float32, gradients_cpu_float32 = _float32.render, _float32.gradients
_dense, _triton = Renderer("torch"), Renderer("cuda", torch.float32)
_webgpu = Renderer("webgpu", torch.float32)
render_torch, gradients_torch = _dense.render, _dense.gradients
render_cuda, gradients_cuda = _triton.render, _triton.gradients
render_webgpu, gradients_webgpu = _webgpu.render, _webgpu.gradients

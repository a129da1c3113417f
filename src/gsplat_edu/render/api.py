"""The one door to rendering: raw parameters and a camera in, an image and what training needs out."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import overload

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.camera import Camera, CameraLike, as_camera
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians, check_tensor
from gsplat_edu.render.backends import resolve_backend
from gsplat_edu.render.output import RenderOutput, RenderStack
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch_reference import render_dense


@overload
def render(
    gaussians: Gaussians,
    camera: CameraLike,
    *,
    settings: RenderSettings | None = None,
    background: Tensor | None = None,
    backend: str = "auto",
) -> RenderOutput: ...


@overload
def render(
    gaussians: Gaussians,
    camera: Sequence[CameraLike],
    *,
    settings: RenderSettings | None = None,
    background: Tensor | None = None,
    backend: str = "auto",
) -> RenderStack: ...


def render(
    gaussians: Gaussians,
    camera: CameraLike | Sequence[CameraLike],
    *,
    settings: RenderSettings | None = None,
    background: Tensor | None = None,
    backend: str = "auto",
) -> RenderOutput | RenderStack:
    """Render Gaussians as seen by a camera, or by several of one size.

    Args:
        gaussians: N Gaussians, raw parameters, float32 or float64 (cuda: float32).
        camera: The camera, a `Camera` or anything with its members (`gsplat_edu.CameraLike`); or a sequence of cameras
            of one image size.
        settings: Background, SH degree, antialiasing, depth; the defaults where None.
        background: (3,) background as a tensor, to differentiate in; that of the settings where None.
        backend: "auto" for the fastest there is where the Gaussians are, or a backend by name (see
            `gsplat_edu.render.backends`).

    Returns:
        The view and what density control needs; for several cameras their views stacked.

    Raises:
        BackendUnavailableError: the backend does not run here.
        ShapeError: the background is not of shape (3,), or cameras have different sizes.
        ArgumentError: on the backend torch, a parameter is NaN or infinite, or a quaternion has zero length.
            The kernels leave such a Gaussian out instead, with gradient zero, and no other notices.

    Differentiable in: every raw parameter of the Gaussians, and the background. Not in: the camera.
    """
    settings = settings or RenderSettings()
    name = resolve_backend(backend, gaussians.means.device)
    if background is None:
        background = _background(settings.background, gaussians.means.dtype, gaussians.means.device)
    else:
        check_tensor("background", background, (3,), {})
        background = background.to(gaussians.means)
    if not isinstance(camera, Sequence):
        return _render_one(name, gaussians, as_camera("camera", camera), settings, background)
    cameras = [as_camera(f"camera[{k}]", one) for k, one in enumerate(camera)]
    if len({(c.H, c.W) for c in cameras}) != 1:
        raise ArgumentError(
            "camera: is a sequence that is empty or of different image sizes; render those one by one"
        )
    views = tuple(_render_one(name, gaussians, c, settings, background) for c in cameras)
    depths = [view.depth for view in views if view.depth is not None]
    return RenderStack(
        torch.stack([view.image for view in views]),
        torch.stack([view.transmittance for view in views]),
        torch.stack(depths) if depths else None,
        views,
    )


def _background(color: tuple[float, float, float], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a colour, which the settings have checked, as a tensor; it is sent to a GPU once, as that waits."""
    if device.type == "cpu":
        return torch.tensor(color, dtype=dtype)
    return _sent(color, dtype, device)


@functools.lru_cache(maxsize=64)
def _sent(color: tuple[float, float, float], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # else the first render decides what the others may do with it
        return torch.tensor(color, dtype=dtype, device=device)


def _render_one(
    name: str, gaussians: Gaussians, camera: Camera, settings: RenderSettings, background: Float[Tensor, "3"]
) -> RenderOutput:
    if name == "cpu":
        from gsplat_edu.render.cpu import render_cpu  # the native module is there: backends.py has seen to it

        return render_cpu(gaussians, camera, settings, background)
    if name == "cuda":
        from gsplat_edu.render.triton.rasterize import render_triton  # so is triton

        return render_triton(gaussians, camera, settings, background)
    return render_dense(gaussians, camera, settings, background)

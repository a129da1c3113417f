"""The public rendering function: from raw parameters and a camera to an image and the data for training."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import overload

import torch
from torch import Tensor

from gsplat_edu.base.derivatives import opaque, refuse_vmap
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.headroom import require_memory
from gsplat_edu.base.validation import ArrayLike, Shape, check_shape, float64_array, of_type
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import Extra, RenderOutput, RenderStack, check_features
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussians import Gaussians, check_tensor

BYTES_PER_PIXEL = 40
"""Memory for creating and using an image: 20 bytes as float32 with transmittance and depth, and as much again for its
copies as bytes or its gradient."""

BYTES_PER_CHANNEL = 8
"""The same for each channel of features."""


@overload
def render(
    gaussians: Gaussians,
    camera: CameraLike | CameraTensors,
    *,
    settings: RenderSettings | None = None,
    background: Tensor | ArrayLike | None = None,
    features: Tensor | ArrayLike | None = None,
    needed: Tensor | None = None,
    backend: str | Backend = "auto",
) -> RenderOutput: ...


@overload
def render(
    gaussians: Gaussians,
    camera: Sequence[CameraLike | CameraTensors],
    *,
    settings: RenderSettings | None = None,
    background: Tensor | ArrayLike | None = None,
    features: Tensor | ArrayLike | None = None,
    backend: str | Backend = "auto",
) -> RenderStack: ...


@opaque
def render(
    gaussians: Gaussians,
    camera: CameraLike | CameraTensors | Sequence[CameraLike | CameraTensors],
    *,
    settings: RenderSettings | None = None,
    background: Tensor | ArrayLike | None = None,
    features: Tensor | ArrayLike | None = None,
    needed: Tensor | None = None,
    backend: str | Backend = "auto",
) -> RenderOutput | RenderStack:
    """Render Gaussians from one camera, or from several of equal image size.

    Args:
        gaussians: N Gaussians, raw parameters, float32 or float64 (cuda: float32).
        camera: A `Camera` or any object with its members (`gsplat_edu.CameraLike`); `CameraTensors` for gradients of
            its pose, lens and shutter; or a sequence of cameras of equal image size.
        settings: Background, SH degree, antialiasing, depths; None uses the defaults.
        background: (3,) background, as a tensor for differentiation; None uses the settings' background.
        features: (N, C) numbers to composite beside the colours, as a tensor of the Gaussians' dtype and device for
            differentiation; None for none.
            The backend cpu composites 32 at a time: every further 32 take another projection, sort and two passes.
        needed: (H, W) bool, true for the pixels of one camera that are used, which saves the time of the others; None
            for all. The others are undefined, but finite, and their gradients have to be 0.
        backend: "auto" for the fastest one on the Gaussians' device, or a backend by name (see
            `gsplat_edu.render.backends`), or a backend that is loaded already.

    Returns:
        The view, including the data for density control; for several cameras, a stack of views.

    Raises:
        BackendUnavailableError: the backend cannot run here.
        ShapeError: the background is not of shape (3,), features or needed have another shape, or cameras have
            different sizes.
        NotEnoughMemoryError: the image alone needs more memory than is free.
        ArgumentError: an argument has another type, or a feature is NaN or infinite; or on torch, a parameter is, or a
            quaternion has zero length. The kernels skip such a Gaussian; it has zero gradient and no effect on others.

    Differentiable in: every raw parameter of the Gaussians, the background, the features, and a camera of tensors.
    """
    _check_gaussians(gaussians)
    refuse_vmap("render in a loop, or give render several cameras")
    settings = RenderSettings() if settings is None else settings
    of_type("settings", settings, RenderSettings)
    chosen = backend if isinstance(backend, Backend) else load_backend(backend, gaussians.means.device)
    extra = _extra(gaussians.means, settings, background, features)
    if not isinstance(camera, Sequence):
        one = _checked("camera", camera)
        extra = extra._replace(needed=_checked_needed(needed, one, gaussians.means))
        return _render_one(chosen, gaussians, one, settings, extra)
    if needed is not None:
        raise ArgumentError("needed: describes the pixels of one camera; render the cameras one by one")
    cameras = [_checked(f"camera[{k}]", one) for k, one in enumerate(camera)]
    if len({(c.H, c.W) for c in cameras}) != 1:
        raise ArgumentError(
            "camera: is an empty sequence or has different image sizes; render the cameras one by one"
        )
    return _stack(tuple(_render_one(chosen, gaussians, c, settings, extra) for c in cameras))


def _check_gaussians(given: object) -> None:
    """Check that Gaussians are given, and not what holds them: a scene, or a trainer."""
    if isinstance(getattr(given, "gaussians", None), Gaussians):
        raise ArgumentError(f"gaussians: is a {type(given).__name__}; give its Gaussians, .gaussians")
    of_type("gaussians", given, Gaussians)


def _extra(
    means: Tensor,
    settings: RenderSettings,
    background: Tensor | ArrayLike | None,
    features: Tensor | ArrayLike | None,
) -> Extra:
    """Check background and features, and return them as tensors of the Gaussians' dtype and device."""
    if background is None:
        background = _background(settings.background, means.dtype, means.device)
    else:
        background = _as_tensor("background", background, (3,), means)
        check_tensor("background", background, (3,), {})
        background = background.to(means)
    if features is not None:
        features = _as_tensor("features", features, ("N", "C"), means)
        check_features(features, means)
    return Extra(background, features)


def _as_tensor(name: str, value: Tensor | ArrayLike, shape: Shape, like: Tensor) -> Tensor:
    """Return a tensor as it is, and an array or numbers as a tensor of this one's dtype and device."""
    if isinstance(value, Tensor):
        return value
    return torch.from_numpy(float64_array(name, value, shape).copy()).to(like)


def _checked_needed(needed: Tensor | None, camera: Camera | CameraTensors, means: Tensor) -> Tensor | None:
    """Check that `needed` marks the pixels of a camera, on the device of the Gaussians."""
    if needed is None:
        return None
    of_type("needed", needed, Tensor)
    check_shape("needed", needed.shape, (camera.H, camera.W), {})
    if needed.dtype != torch.bool or needed.device != means.device:
        raise ArgumentError(
            f"needed: is {needed.dtype} on {needed.device}, but has to be torch.bool on {means.device}"
        )
    return needed


def _stack(views: tuple[RenderOutput, ...]) -> RenderStack:
    return RenderStack(
        torch.stack([view.image for view in views]),
        torch.stack([view.transmittance for view in views]),
        _stacked([view.depth for view in views]),
        views,
        _stacked([view.features for view in views]),
        _stacked([view.median_depth for view in views]),
    )


def _stacked(images: Sequence[Tensor | None]) -> Tensor | None:
    drawn = [image for image in images if image is not None]
    return torch.stack(drawn) if drawn else None


def _checked(name: str, camera: CameraLike | CameraTensors) -> Camera | CameraTensors:
    return camera if isinstance(camera, CameraTensors) else as_camera(name, camera)


def _background(color: tuple[float, float, float], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a validated colour as a tensor. It is sent to a GPU only once, because that synchronises."""
    if device.type == "cpu":
        return torch.tensor(color, dtype=dtype)
    return _sent(color, dtype, device)


@functools.lru_cache(maxsize=64)
def _sent(color: tuple[float, float, float], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # otherwise a first render in inference mode would restrict later ones
        return torch.tensor(color, dtype=dtype, device=device)


def _render_one(
    backend: Backend,
    gaussians: Gaussians,
    camera: Camera | CameraTensors,
    settings: RenderSettings,
    extra: Extra,
) -> RenderOutput:
    channels = 0 if extra.features is None else extra.features.shape[1]
    if gaussians.means.device.type == "cpu":
        require_memory(
            f"an image of {camera.W}x{camera.H} px",
            (BYTES_PER_PIXEL + BYTES_PER_CHANNEL * channels) * int(camera.W) * int(camera.H),
            "close other programs, or render at a smaller `size`",
        )
    if not camera.pinhole:
        backend.require("lens", "camera: its projection or rolling shutter")
    if settings.stop != "tile":
        backend.require("stop", f"stop: {settings.stop!r}")
    return backend.rasterize(gaussians, camera, settings, extra)

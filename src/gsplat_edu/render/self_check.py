"""Check the backends cuda and webgpu on a small scene before their first use.

A GPU, its driver and the installed compiler may differ from everything the kernels were tested on. The first use on a
device therefore renders and differentiates a scene of 64 Gaussians, and compares both with float64 on the CPU. A
passed check is stored in the user's cache folder, under the device's name and the versions of all components.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.base.constants import ALPHA_MIN
from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.base.files import written_aside
from gsplat_edu.engine.passes import FOLDER
from gsplat_edu.ops import kernels
from gsplat_edu.render.output import Extra, RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.step_check import step_error
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter

IMAGE_BOUND = 1.1 * ALPHA_MIN
"""Largest error of a pixel, relative to the brightest or 1. If float32 rounds an alpha across 1/255, a pixel loses or
gains that Gaussian: at most 1/255 of its colour. Another tenth covers all other rounding. tests/gpu uses the same
bound."""

MEAN_BOUND = 1e-5
"""Largest mean error of all pixels. Rounding alone gives about 1e-7, and too few pixels lose a Gaussian to matter; a
wrong formula changes most pixels."""

GRADIENT_BOUND = 3e-4
"""Largest error of a gradient, relative to the largest entry of its tensor, as in tests/gpu and tests/native."""

SETTINGS = RenderSettings(background=(0.2, 0.5, 0.9), jacobian_limit=1.3)


Render = Callable[[Gaussians, Camera, RenderSettings, Extra], RenderOutput]


def cuda_failure(device: torch.device | None = None) -> str | None:
    """Describe the failure of the kernels of the backend cuda on a device; None if they pass.

    The result is cached for the process; a pass is stored until device, driver or versions change.

    Args:
        device: A CUDA device, the current one if None or without an index; or the CPU, under Triton's interpreter.
    """
    try:
        if device is None or (device.type == "cuda" and device.index is None):
            device = torch.device("cuda", torch.cuda.current_device())
        return _failure(device)
    except Exception as error:  # compilers and drivers raise anything; the CPU renders instead
        return _does_not_run(error)


def webgpu_failure() -> str | None:
    """Describe the failure of the kernels of the backend webgpu on the adapter that it uses; None if they pass.

    Cached and stored as for `cuda_failure`.
    """
    try:
        return _adapter_failure()
    except BackendUnavailableError:
        raise  # it says what failed
    except Exception as error:
        return _does_not_run(error)


def forget_checks() -> None:
    """Forget the results of this process, such as after a driver was replaced; passes that are stored still count."""
    _failure.cache_clear()
    _adapter_failure.cache_clear()


def _does_not_run(error: Exception) -> str:
    first = str(error).strip().splitlines()
    return f"they do not run ({type(error).__name__}: {first[0] if first else 'no message'})"


@functools.cache
def _failure(device: torch.device) -> str | None:
    return _checked_once("cuda", _identity(device), lambda: kernel_error(device))


@functools.cache
def _adapter_failure() -> str | None:
    from gsplat_edu.render.webgpu import adapter_name

    name = adapter_name()
    on = f"{name.name}, {name.interface}, {name.driver}, torch {torch.__version__}, wgpu {version('wgpu')}"
    return _checked_once("webgpu", f"{on}, kernels {hash_of_kernels()}", shader_error)


def _checked_once(backend: str, identity: str, check: Callable[[], str | None]) -> str | None:
    """Return what a check finds, without running it if it has passed with this identity before."""
    passed = _passed(backend)
    if identity in passed:
        return None
    failure = check()
    if failure is None:
        _remember(backend, [*passed, identity])
    return failure


def kernel_error(device: torch.device) -> str | None:
    """Render and differentiate the scene on a device with Triton's kernels, and compare with float64 on the CPU.

    Args:
        device: As for `cuda_failure`.

    Returns:
        The first result that exceeds its bound, and its error; None if none does.
    """
    from gsplat_edu.render.triton.rasterize import render_triton

    for camera in (CHECK_CAMERA, *CHECK_LENSES):
        if failure := _error(render_triton, device, camera):
            return failure
    return None


def shader_error() -> str | None:
    """Do the same on the adapter of the backend webgpu, and compare a step of a training that stays there."""
    from gsplat_edu.render.webgpu import render_webgpu
    from gsplat_edu.render.webgpu_resident import WebgpuRun

    scene = check_scene(torch.float32)
    for camera in (CHECK_CAMERA, *CHECK_LENSES):
        if failure := _error(render_webgpu, torch.device("cpu"), camera):
            return failure
    return step_error(
        WebgpuRun(scene.sh_rest.shape[1]), scene, CHECK_CAMERA, SETTINGS, _exact, GRADIENT_BOUND
    )


def _error(render: Render, device: torch.device, camera: Camera) -> str | None:
    image, gradients = _differentiated(
        check_scene(torch.float32).to(device),
        lambda g, bg: render(g, camera, SETTINGS, Extra(bg)),
    )
    truth, expected = _differentiated(check_scene(torch.float64), lambda g, bg: _exact(g, bg, camera))
    bright = max(1.0, float(truth.abs().max()))
    error = (image - truth).abs()
    worst, mean = float(error.max()) / bright, float(error.mean()) / bright
    if not (worst <= IMAGE_BOUND and mean <= MEAN_BOUND):
        return f"the image of a test scene is wrong by {worst:.1g} at worst and {mean:.1g} on average"
    for name, true in expected.items():
        off = float((gradients[name] - true).abs().max() / true.abs().max())
        if not off <= GRADIENT_BOUND:
            return f"the gradient of {name} is wrong by {off:.1g} of its largest entry on a test scene"
    return None


CHECK_CAMERA = Camera(np.eye(3), (0.0, 0.0, -3.0), fx=44.0, fy=47.0, cx=23.1, cy=18.4, H=37, W=46)
"""The image size is not a multiple of the tile size, and the principal point is off-centre."""


CHECK_LENSES = (
    Camera(np.eye(3), (0.0, 0.0, -1.2), fx=12.0, fy=13.0, cx=23.1, cy=18.4, H=37, W=46).through(
        Projection("fisheye", Distortion((0.05, -0.01))),
        RollingShutter((0.06, -0.05, 0.04), (0.05, 0.03, -0.04)),
    ),
    Camera.panorama(np.eye(3), (0.0, 0.0, 1.2), 23, 46),
)
"""A distorted fisheye with a rolling shutter; and a panorama with the scene behind it, on both sides of its seam."""


def check_scene(dtype: torch.dtype) -> Gaussians:
    """Make 64 Gaussians around the origin, with harmonics of degree 3 and distinct depths.

    The scene triggers neither the near plane nor early termination: with these, rounding would decide what is drawn.

    Args:
        dtype: Type of the tensors; the values are those of float32.
    """
    n = 64
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = torch.rand(n, 3, generator=generator) * 1.6 - 0.8
    means[:, 2] = torch.randperm(n, generator=generator) / n - 0.5
    return Gaussians(
        means=means,
        quats=normal(n, 4),
        log_scales=0.5 * normal(n, 3) - 2.3,
        sh0=normal(n, 1, 3),
        sh_rest=0.3 * normal(n, 15, 3),
        logit_opacities=normal(n) - 1.5,
    ).map(lambda tensor: tensor.to(dtype))


def _exact(gaussians: Gaussians, background: Tensor, camera: Camera = CHECK_CAMERA) -> RenderOutput:
    if kernels.REASON is None:
        from gsplat_edu.render.cpu import render_cpu

        return render_cpu(gaussians, camera, SETTINGS, Extra(background))
    from gsplat_edu.render.torch_reference import render_dense

    return render_dense(gaussians, camera, SETTINGS, Extra(background))


def _differentiated(
    gaussians: Gaussians, render: Callable[[Gaussians, Tensor], RenderOutput]
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the image, and the gradients of a loss with random weights for every pixel of all three images."""
    gaussians = gaussians.trainable()
    background = torch.tensor(SETTINGS.background).to(gaussians.means).requires_grad_()
    with torch.enable_grad():
        out = render(gaussians, background)
        assert out.depth is not None
        generator = torch.Generator().manual_seed(1)
        losses = [
            (image * torch.randn(image.shape, generator=generator).to(image)).sum()
            for image in (out.image, out.transmittance, out.depth)
        ]
        torch.stack(losses).sum().backward()  # type: ignore[no-untyped-call]
    tensors = gaussians.tensors() | {"background": background}
    exact = {name: tensor.grad.double().cpu() for name, tensor in tensors.items() if tensor.grad is not None}
    return out.image.detach().double().cpu(), exact


def _identity(device: torch.device) -> str:
    """Identify everything that a pass depends on: device, driver, compiler, torch, and the source of our kernels."""
    if device.type == "cuda":
        name, capability = torch.cuda.get_device_name(device), torch.cuda.get_device_capability(device)
        on = f"{name}, {capability}, CUDA {torch.version.cuda}, driver {_driver()}"
    else:
        on = "interpreter"
    return f"{on}, torch {torch.__version__}, triton {version('triton')}, kernels {hash_of_kernels()}"


def hash_of_kernels() -> str:
    """Return a hash of the modules and shaders that render."""
    source = hashlib.sha256()
    for folder, pattern in ((Path(__file__).parent, "*.py"), (FOLDER, "*.py"), (FOLDER, "*.wgsl")):
        for path in sorted(folder.rglob(pattern)):
            source.update(path.read_bytes())
    return source.hexdigest()[:16]


def _driver() -> str:
    """Return the NVIDIA driver's version from its kernel module; "unknown" if it gives none."""
    try:
        return Path("/sys/module/nvidia/version").read_text().strip()
    except OSError:
        return "unknown"


def _memory(backend: str) -> Path:
    """Return the file that stores a backend's passed checks."""
    folder = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(folder) / "gsplat_edu" / f"{backend}_passed.json"


def _passed(backend: str) -> list[str]:
    try:
        found = json.loads(_memory(backend).read_text())
    except (OSError, ValueError, RecursionError):
        return []  # the check runs again
    return [entry for entry in found if isinstance(entry, str)] if isinstance(found, list) else []


def _remember(backend: str, identities: list[str]) -> None:
    try:
        with written_aside(_memory(backend)) as path:
            path.write_text(json.dumps(identities[-20:]))
    except OSError:
        pass  # the next process checks again

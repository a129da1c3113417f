"""The check of the backend webgpu on an adapter before its first use: renders, and a step of a training there.

The gradients of the step are read from Adam's first moments. Adam and the noise are then repeated from what the device
had, so that each is compared by itself.
"""

from __future__ import annotations

import functools
from importlib.metadata import version

import torch
from torch import Tensor

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.ops.adam import adam_in_torch
from gsplat_edu.ops.losses import l1_ssim_in_torch
from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.ops.noise import NoiseNumbers, add_noise_in_torch
from gsplat_edu.render.backend import PROCESSOR, Rasterize
from gsplat_edu.render.output import Extra
from gsplat_edu.render.resident import ResidentRun, RunRules, RunState, RunTarget
from gsplat_edu.render.self_check import (
    CHECK_CAMERA,
    GRADIENT_BOUND,
    SETTINGS,
    check_scene,
    checked_once,
    does_not_run,
    hash_of_kernels,
    render_error,
)
from gsplat_edu.scene.gaussians import Gaussians

BETAS = 0.9, 0.999
WEIGHT = 0.2
NUMBERS = AdamNumbers(1e-2, *BETAS, 1e-15, 1 - BETAS[0], 1 - BETAS[1])
RULES = RunRules(WEIGHT, collects=True)
NOISE = NoiseNumbers(2**40 + 12345, 0.5, 100.0, 0.2)

ADAM_BOUND = 1e-5
"""Largest error of a step of Adam, relative to the rate: ten roundings are 1e-6."""

NOISE_BOUND = 1e-5
"""Largest error of a random step, relative to the largest that the Gaussian can take; see `add_noise_in_torch`."""

FAR = 0.3
"""Distance of the photo's values from the image's. Where they are equal, rounding decides the sign of L1's gradient."""


def webgpu_failure(exact: Rasterize) -> str | None:
    """Describe the failure of the kernels of the backend webgpu on the adapter that it uses; None if they pass.

    The result is cached for the process; a pass is stored until adapter, driver or versions change.

    Args:
        exact: Renders tensors on the CPU in float64.
    """
    try:
        return _failure(exact)
    except BackendUnavailableError:
        raise  # it says what failed
    except Exception as error:
        return does_not_run(error)


def forget_checks() -> None:
    """Forget the results of this process, such as after a driver was replaced; passes that are stored still count."""
    _failure.cache_clear()


@functools.cache
def _failure(exact: Rasterize) -> str | None:
    from gsplat_edu.render.webgpu.render import adapter_name

    name = adapter_name()
    on = f"{name.name}, {name.interface}, {name.driver}, torch {torch.__version__}, wgpu {version('wgpu')}"
    return checked_once("webgpu", f"{on}, kernels {hash_of_kernels()}", lambda: shader_error(exact))


def shader_error(exact: Rasterize) -> str | None:
    """Compare what the WGSL kernels compute on the adapter with float64 on the CPU; see `kernel_error` of cuda."""
    from gsplat_edu.render.webgpu.render import render_webgpu
    from gsplat_edu.render.webgpu.resident import WebgpuRun

    if failure := render_error(render_webgpu, exact, PROCESSOR):
        return failure
    scene = check_scene(torch.float32)
    return step_error(WebgpuRun(scene.sh_rest.shape[1]), scene, exact)


def step_error(run: ResidentRun, scene: Gaussians, exact: Rasterize) -> str | None:
    """Take a step on the device, and compare it.

    Args:
        run: The device's training; it loses what it had.
        scene: N Gaussians, float32, on the CPU.
        exact: Renders tensors on the CPU in float64.

    Returns:
        The first result that exceeds its bound, and its error; None if none does.
    """
    photo, loss, gradients, norms = _exact_gradients(scene, exact)
    zeros = {name: torch.zeros_like(tensor) for name, tensor in scene.tensors().items()}
    nothing = torch.zeros(len(scene))
    run.load(RunState(scene.tensors(), zeros, zeros, nothing, nothing))
    target = RunTarget(0, photo, None, photo)
    sums = run.step(CHECK_CAMERA, SETTINGS, target, dict.fromkeys(zeros, NUMBERS), RULES)()
    after = run.read()
    if not abs(sums.photo - loss) <= GRADIENT_BOUND * loss:
        return f"the loss of a test scene is wrong by {abs(sums.photo - loss) / loss:.1g} of itself"
    found = {name: after.first[name].double() / (1 - BETAS[0]) for name in gradients}
    for name, true in (gradients | {"norms": norms}).items():
        off = float(
            ((found | {"norms": after.norm_sums.double()})[name] - true).abs().max() / true.abs().max()
        )
        if not off <= GRADIENT_BOUND:
            return (
                f"a training's gradient of {name} is wrong by {off:.1g} of its largest entry on a test scene"
            )
    if not bool((after.times_visible == (norms > 0)).all()):
        return "a training counts other Gaussians as visible than the CPU does on a test scene"
    return _adam_error(scene, after) or _noise_error(run, after)


def _exact_gradients(scene: Gaussians, render: Rasterize) -> tuple[Tensor, float, dict[str, Tensor], Tensor]:
    """Return a photo, and in float64 the loss, the gradients of the raw parameters and the norms of all Gaussians."""
    exact = scene.map(lambda tensor: tensor.double()).trainable()
    with torch.enable_grad():
        background = torch.tensor(SETTINGS.background, dtype=torch.float64)
        output = render(exact, CHECK_CAMERA, SETTINGS, Extra(background))
        image = output.image
        away = torch.where(image.detach() > 0.5, image.detach() - FAR, image.detach() + FAR).clamp(0, 1)
        photo = (255 * away).round().to(torch.uint8)
        loss = l1_ssim_in_torch(image, photo, WEIGHT)
        loss.backward()  # type: ignore[no-untyped-call]
    norms = torch.zeros(len(scene), dtype=torch.float64)
    norms[output.visible] = output.means2d_grad_norms().double()
    gradients = {name: t.grad for name, t in exact.tensors().items() if t.grad is not None}
    return photo, float(loss.detach()), gradients, norms


def _adam_error(before: Gaussians, after: RunState) -> str | None:
    for name, start in before.tensors().items():
        gradient = after.first[name].double() / (1 - BETAS[0])
        parameter, first, second = start.double(), torch.zeros_like(gradient), torch.zeros_like(gradient)
        adam_in_torch(parameter, first, second, gradient, NUMBERS)
        moved = after.gaussians[name].double()
        off = (moved - parameter).abs() - torch.finfo(torch.float32).eps * start.abs()
        off_second = (after.second[name].double() - second).abs() - ADAM_BOUND * second
        worst = float(off.max()) / NUMBERS.rate
        if not (worst <= ADAM_BOUND and float(off_second.max()) <= 0):
            return f"a step of Adam for {name} is wrong by {worst:.1g} of its rate on a test scene"
    return None


def _noise_error(run: ResidentRun, before: RunState) -> str | None:
    run.add_noise(NOISE, RULES)
    found = run.read().gaussians["means"].double()
    moved = Gaussians(**{name: tensor.double() for name, tensor in before.gaussians.items()})
    largest = 5.8 * NOISE.amount * moved.scales.amax(dim=1, keepdim=True) ** 2
    add_noise_in_torch(moved, NOISE)
    off = (found - moved.means).abs() - torch.finfo(torch.float32).eps * moved.means.abs()
    worst = float((off / largest).max())
    if not worst <= NOISE_BOUND:
        return f"a training's noise is wrong by {worst:.1g} of its largest step on a test scene"
    return None

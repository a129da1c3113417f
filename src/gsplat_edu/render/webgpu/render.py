"""The backend webgpu: the engine's WGSL kernels behind one autograd function, for tensors on the CPU.

    project -> sort -> intersect -> composite, and back: composite_backward -> project_backward

A render uploads the Gaussians and reads the images; its backward pass uploads their gradients and reads those of the
Gaussians. What it drew stays on the device until autograd lets go of it. Every sum has a fixed order, so two runs on
one device give the same bits.
"""

from __future__ import annotations

import contextlib
import functools
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.errors import ArgumentError, BackendWarning
from gsplat_edu.engine.adapters import AdapterName
from gsplat_edu.engine.failures import DeviceLostError
from gsplat_edu.engine.frame import GRADS, FrameGradients, Pool, Scene, differentiate_frame, draw_frame
from gsplat_edu.engine.host import Device
from gsplat_edu.engine.statistics import Asked
from gsplat_edu.engine.view import DeviceView
from gsplat_edu.render.camera_tensors import POSE, CameraTensors, camera_gradients, split_camera
from gsplat_edu.render.output import Extra, RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians, check_tensor

_Found = TypeVar("_Found")

MOST_LOSSES = 2
"""How often a lost device is replaced before the work is given up."""

CORE = {"means": 3, "quats": 4, "log_scales": 3, "sh0": 3, "logit_opacities": 1}
"""Parameters in the order of `Scene.core`, and how many numbers each has."""


@dataclass
class _Call:
    """State of one render: inputs that are no tensors, and outputs that are no images."""

    view: DeviceView
    depth: bool
    visible: Tensor = field(init=False)
    radii: Tensor = field(init=False)
    num_pairs: int = field(init=False)
    norms: Tensor | None = None
    asked: Asked | None = None
    statistics: Tensor | None = None


def render_webgpu(
    gaussians: Gaussians, camera: Camera | CameraTensors, settings: RenderSettings, extra: Extra
) -> RenderOutput:
    """Render raw parameters; `gsplat_edu.render.api.render` validates the arguments.

    Args:
        gaussians: N Gaussians, float32, on the CPU.
        camera: The camera.
        settings: The settings.
        extra: Background and features, of the Gaussians' dtype and device.

    Returns:
        The view. Differentiable in every raw parameter, background, features and a camera of tensors.

    Raises:
        ArgumentError: the Gaussians are not float32 on the CPU.
        BackendUnavailableError: there is no adapter, or it fails.
    """
    means = gaussians.means
    if means.dtype != torch.float32 or means.device.type != "cpu":
        raise ArgumentError(
            f"means: are {means.dtype} on {means.device}, but the backend webgpu needs float32 on the CPU"
        )
    value, pose = split_camera(camera)
    background = tuple(extra.background.detach().tolist())
    degree = min(settings.sh_degree, gaussians.sh_degree)
    call = _Call(engine_view(value, settings, background, degree), settings.depth)
    tensors = gaussians.tensors()
    parameters = [tensors[name] for name in (*CORE, "sh_rest")]
    image, transmittance, depth, mixed, median = _Rasterize.apply(  # type: ignore[no-untyped-call]
        call, extra.background, extra.features, *pose, *parameters
    )

    def norms() -> Tensor:
        if call.norms is None:
            raise ArgumentError("means2d: has no gradient; call backward on a loss of this image first")
        return call.norms[call.visible]

    return RenderOutput(
        image,
        transmittance,
        depth if settings.depth else None,
        call.visible,
        call.radii,
        call.num_pairs,
        norms,
        features=None if extra.features is None else mixed,
        median_depth=median if settings.median_depth else None,
        collector=functools.partial(_collect, call, tensors["sh_rest"].shape[1]),
    )


def _collect(call: _Call, rest: int, errors: Tensor | None) -> Callable[[], Tensor]:
    """Ask for statistics of the next backward pass; return a function that returns them for the visible Gaussians."""
    given = None
    if errors is not None:
        check_tensor("errors", errors, (call.view.camera.H, call.view.camera.W), {})
        given = errors.detach().to("cpu", torch.float32).contiguous().numpy().copy()
    call.asked = Asked(call.view.packed(rest), given)

    def found() -> Tensor:
        if call.statistics is None:
            raise ArgumentError("collect: there is nothing yet; call backward on a loss of this image first")
        return call.statistics[call.visible]

    return found


def engine_view(
    camera: Camera, settings: RenderSettings, background: tuple[float, ...], degree: int
) -> DeviceView:
    """Return camera and settings as the engine takes them.

    Args:
        camera: The camera.
        settings: The settings.
        background: (3,) the colour behind everything.
        degree: Degree of the harmonics that are used; the Gaussians have them.
    """
    red, green, blue = background
    return DeviceView(
        camera, (red, green, blue), degree, settings.antialiased, settings.dilation, settings.jacobian_limit,
        settings.alpha_max, settings.z_near, settings.stop == "pixel",
    )  # fmt: skip


@first_derivative_only("backend 'webgpu'", 'backend="torch"')
class _Rasterize(torch.autograd.Function):
    """The complete renderer as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        call: _Call,
        background: Tensor,
        features: Tensor | None,
        *tensors: Tensor | None,  # the camera's, then the parameters
    ) -> tuple[Tensor, ...]:
        parameters = [tensor for tensor in tensors[POSE:] if tensor is not None]
        scene = _scene(parameters, features)
        frame = surviving(lambda: draw_frame(_pool(), scene, call.view))
        call.visible, call.radii = torch.from_numpy(frame.visible), torch.from_numpy(frame.radii)
        call.num_pairs = frame.num_pairs
        planes = (frame.image, frame.transmittance, frame.depth, frame.features, frame.median_depth)
        image, transmittance, depth, mixed, median = (
            background.new_empty(0) if plane is None else torch.from_numpy(plane.copy()) for plane in planes
        )
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(median)
        ctx.call, ctx.frame = call, frame
        ctx.save_for_backward(features, transmittance, *parameters)
        return image, transmittance, depth, mixed, median

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        features, transmittance, *parameters = ctx.saved_tensors
        call: _Call = ctx.call
        of_image, of_T, of_depth, of_features, _ = grads
        H, W = transmittance.shape
        upstream = torch.zeros(H, W, GRADS)
        if of_image is not None:
            upstream[..., :3] = of_image
        if of_T is not None:
            upstream[..., 3] = of_T
        if of_depth is not None and call.depth:
            upstream[..., 4] = of_depth
        feature_grads = None if of_features is None else of_features.contiguous().numpy()
        scene = _scene(parameters, features)

        def differentiated() -> FrameGradients:
            if ctx.frame.memory.device is not device():  # that one was lost after the render
                ctx.frame = draw_frame(_pool(), scene, call.view)
            return differentiate_frame(ctx.frame, scene, upstream.numpy(), feature_grads, call.asked)

        found = surviving(differentiated)
        if found.statistics is not None:
            call.statistics = torch.from_numpy(found.statistics)
        norms = torch.from_numpy(found.norms)
        call.norms = norms if call.norms is None else call.norms + norms
        behind = (
            (upstream[..., :3] * transmittance[..., None]).sum(dim=(0, 1))
            if ctx.needs_input_grad[1]
            else None
        )
        with_camera = any(ctx.needs_input_grad[3 : 3 + POSE])
        pose = camera_gradients(
            torch.from_numpy(found.camera) if with_camera else None, ctx.needs_input_grad[3 : 3 + POSE]
        )
        to_features = None if found.features is None else torch.from_numpy(found.features)
        core = torch.split(torch.from_numpy(found.core), list(CORE.values()), dim=1)
        outgoing = [part.reshape(p.shape) for part, p in zip(core, parameters, strict=False)]
        return None, behind, to_features, *pose, *outgoing, torch.from_numpy(found.rest)


@functools.cache
def _default_pool() -> Pool:
    return Pool(Device.default())


_chosen: list[Pool] = []
"""The pools of `rendering_with`, innermost last."""


def _pool() -> Pool:
    return _chosen[-1] if _chosen else _default_pool()


@contextlib.contextmanager
def rendering_with(pool: Pool) -> Iterator[Pool]:
    """Let this backend use another device in a block, in all threads: another adapter, other limits or other shaders.

    Args:
        pool: Has the device; frames use its buffers again.
    """
    _chosen.append(pool)
    try:
        yield pool
    finally:
        _chosen.remove(pool)


def device() -> Device:
    """Return the device that renders.

    Raises:
        BackendUnavailableError: there is none, or it does not start.
    """
    return _pool().device


def replace_device(lost: Device, losses: int, what: str, error: DeviceLostError) -> None:
    """Replace a lost device, and say so.

    Args:
        lost: The device.
        losses: How often that has happened during this work, this time included.
        what: What happens now.
        error: What was noticed.

    Raises:
        DeviceLostError: it has happened too often.
        BackendUnavailableError: the adapter is gone, or does not start.

    Warns:
        BackendWarning: the device is replaced.
    """
    name = lost.name.name
    if losses > MOST_LOSSES:
        raise DeviceLostError(
            f"backend 'webgpu': {name} was lost {losses} times during the same work; update its driver, lower "
            "`max_gaussians` or the `resolution`, or use the backend cpu; resume from the last checkpoint"
        ) from error
    _pool().renew(lost)
    warnings.warn(f"backend 'webgpu': {name} was lost; {what} on a new device", BackendWarning, stacklevel=4)


def surviving(action: Callable[[], _Found]) -> _Found:
    """Return what a function returns; if the device is lost meanwhile, call the function again on a new device.

    Raises:
        BackendUnavailableError: the device fails, or is lost too often.
    """
    losses = 0
    while True:
        used = device()
        try:
            return action()
        except DeviceLostError as error:
            losses += 1
            replace_device(used, losses, "the image is rendered again", error)


def adapter_name() -> AdapterName:
    """Return the adapter that renders.

    Raises:
        BackendUnavailableError: there is none, or it does not start.
    """
    return device().name


def _scene(parameters: tuple[Tensor, ...] | list[Tensor], features: Tensor | None) -> Scene:
    """Return the parameters, those of `CORE` and sh_rest, as the engine takes them."""
    *core, rest = (p.detach() for p in parameters)
    columns = [part.reshape(len(part), width) for part, width in zip(core, CORE.values(), strict=True)]
    return Scene(
        torch.cat(columns, dim=1).numpy(),
        np.ascontiguousarray(rest.numpy()),
        None if features is None else features.detach().contiguous().numpy(),
    )

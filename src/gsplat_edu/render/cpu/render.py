"""The backend cpu: native SIMD kernels behind one autograd function.

    project -> intersect -> composite, and back: composite_backward -> project_backward

The kernels are in `native/`; this module owns the tensors, and the native module validates each of them. No torch
operation lies between parameters and gradients, so the gradients are identical to the bit for any number of threads.

Chapters: 11_tiles, 12_the_backward_pass.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsplat_edu.base.buffers import reusable_tensor
from gsplat_edu.base.derivatives import first_derivative_only, opaque
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.kernels import SUFFIXES, kernel, native, native_array
from gsplat_edu.ops.lenses import native_camera
from gsplat_edu.ops.moments import AdamInBackward, Moments
from gsplat_edu.render.camera_tensors import (
    POSE,
    CameraTensors,
    Pose,
    camera_gradients,
    gradient_numbers,
    split_camera,
)
from gsplat_edu.render.output import MOST_CHANNELS, STATISTICS, Extra, RenderOutput, check_features
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussians import Gaussians, check_tensor


class _Waiting(NamedTuple):
    """A backward pass that has reached the image."""

    frame: Any
    parameters: list[Tensor]
    images: Any
    incoming: Any


@dataclass
class _Call:
    """State of one render: non-tensor inputs and non-image outputs."""

    camera: Camera
    settings: RenderSettings
    sh_degree: int
    direct: bool
    needed: Tensor | None = None
    visible: Tensor = field(init=False)
    radii: Tensor = field(init=False)
    num_pairs: int = field(init=False)
    norms: Tensor | None = None
    deferred: bool = False
    waiting: _Waiting | None = None
    collecting: bool = False
    errors: Tensor | None = None
    statistics: Tensor | None = None
    order: Tensor | None = None

    def for_features(self) -> _Call:
        """Return a call that composites further features of the same view."""
        settings = dataclasses.replace(self.settings, depth=False, median_depth=False)
        return _Call(self.camera, settings, self.sh_degree, self.direct, self.needed, order=self.order)


def render_cpu(
    gaussians: Gaussians, camera: Camera | CameraTensors, settings: RenderSettings, extra: Extra
) -> RenderOutput:
    """Render raw parameters; `gsplat_edu.render.api.render` validates the arguments.

    Args:
        gaussians: N Gaussians, float32 or float64, on the CPU.
        camera: The camera.
        settings: The settings.
        extra: Background and features, of the Gaussians' dtype, and the pixels that are needed.

    Returns:
        The view. Differentiable in every raw parameter, background, features and a camera of tensors.
    """
    value, pose = split_camera(camera)
    degree, needed = min(settings.sh_degree, gaussians.sh_degree), extra.needed
    needed = None if needed is None else needed.contiguous().view(torch.uint8)
    call = _Call(value, settings, degree, direct=False, needed=needed)
    tensors = gaussians.tensors()
    return _output(call, extra, pose, *(tensors[name] for name in RAW))


@opaque
def render_covariances(
    means: Tensor,
    cov3ds: Tensor,
    colors: Tensor,
    opacities: Tensor,
    camera: CameraLike | CameraTensors,
    settings: RenderSettings | None = None,
    background: Tensor | None = None,
    features: Tensor | None = None,
) -> RenderOutput:
    """Render Gaussians given as covariances and colours, the inputs of the chapter's dense `render_t`.

    Args:
        means: (N, 3) centres, world units.
        cov3ds: (N, 3, 3) covariances, world units squared; symmetry is not checked. Float64 beside float32 means keeps
            the digits of thin ones.
        colors: (N, 3) any range.
        opacities: (N,) 0 to 1.
        camera: A `Camera` or any object with its members; `CameraTensors` for gradients of its pose and intrinsics.
        settings: Background, antialiasing and depth; None uses the defaults.
        background: (3,) background as a tensor, for differentiation; None uses the settings' background.
        features: (N, C) features to composite beside the colours, 32 in a pass; None for none.

    Returns:
        The view.

    Raises:
        ShapeError: a shape differs, or the arguments have different N.
        ArgumentError: a value is NaN or infinite, the dtypes other than that of `cov3ds` are not all float32 or all
            float64, or `camera` is invalid.

    Differentiable in: means, cov3ds, colors, opacities, background, features, and a camera of tensors.
    """
    settings = settings or RenderSettings()
    sizes: dict[str, int] = {}
    check_tensor("means", means, ("N", 3), sizes)
    check_tensor("cov3ds", cov3ds, ("N", 3, 3), sizes)
    if cov3ds.dtype not in (means.dtype, torch.float64):
        raise ArgumentError(f"cov3ds: are {cov3ds.dtype}, but have to be {means.dtype}, as means, or float64")
    check_tensor("colors", colors, ("N", 3), sizes)
    check_tensor("opacities", opacities, ("N",), sizes)
    if background is None:
        background = torch.tensor(settings.background, dtype=means.dtype)
    check_tensor("background", background, (3,), {})
    if features is not None:
        check_features(features, means)
    value, pose = split_camera(camera if isinstance(camera, CameraTensors) else as_camera("camera", camera))
    call = _Call(value, settings, 0, direct=True)
    return _output(call, Extra(background, features), pose, means, cov3ds.double(), colors, opacities)


@opaque
def render_on_screen(
    parameters: tuple[Tensor, Tensor, Tensor, Tensor],
    camera: Camera,
    settings: RenderSettings,
    features: Tensor | None,
    order: Tensor | None,
) -> RenderOutput:
    """Render covariances over black, as `render_covariances` does, without checks of shapes.

    Args:
        parameters: Means, covariances (float64), colours and opacities.
        camera: A pinhole.
        settings: The settings.
        features: (N, C) features to composite, or None.
        order: (N,) not negative, of the means' dtype: sorted by it instead of by depth; None for the depth.

    Returns:
        The view. Differentiable in the parameters and features.
    """
    call, (_, pose) = _Call(camera, settings, 0, direct=True, order=order), split_camera(camera)
    return _output(call, Extra(parameters[0].new_zeros(3), features), pose, *parameters)


RAW = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")
"""Raw parameters, in the order of the renderer's arguments."""

DIRECT = ("means", "cov3ds", "colors", "opacities")
"""Arguments of `render_covariances`, in order."""


def _output(call: _Call, extra: Extra, pose: Pose, *parameters: Tensor) -> RenderOutput:
    dtype, features = parameters[0].dtype, extra.features
    tensors = [p for k, p in enumerate(parameters) if not call.direct or k != DIRECT.index("cov3ds")]
    tensors += [] if features is None else [features]
    if dtype not in SUFFIXES or any(p.dtype != dtype or p.device.type != "cpu" for p in tensors):
        raise ArgumentError("means: the backend cpu needs tensors on the CPU, all float32 or all float64")
    calls, groups = (
        [call],
        [features] if features is None else list(torch.split(features, MOST_CHANNELS, dim=1)),
    )
    image, transmittance, depth, mixed, median = _Rasterize.apply(  # type: ignore[no-untyped-call]
        call, extra.background, groups[0], *pose, *parameters
    )
    for group in groups[1:]:
        calls.append(call.for_features())
        further = _Rasterize.apply(calls[-1], extra.background, group, *pose, *parameters)  # type: ignore[no-untyped-call]
        mixed = torch.cat([mixed, further[3]], dim=-1)

    def norms() -> Tensor:
        found = [each.norms for each in calls if each.norms is not None]
        if not found:
            raise ArgumentError("means2d: has no gradient; call backward on a loss of this image first")
        total = functools.reduce(torch.add, found)
        return total.index_select(0, call.visible)  # in half the time of [call.visible]

    needs_more = any(tensor is not None and tensor.requires_grad for tensor in (*pose, features))
    return RenderOutput(
        image,
        transmittance,
        depth if call.settings.depth else None,
        call.visible,
        call.radii,
        call.num_pairs,
        norms,
        defer=None if needs_more or features is not None else _defer(call, extra.background, parameters),
        features=None if features is None else mixed,
        median_depth=median if call.settings.median_depth else None,
        collector=functools.partial(_collect, calls, parameters[0]),
    )


def _collect(calls: Sequence[_Call], means: Tensor, errors: Tensor | None) -> Callable[[], Tensor]:
    """Ask for statistics of the next backward pass; return a function that returns them for the visible Gaussians."""
    if errors is not None:
        check_tensor("errors", errors, (calls[0].camera.H, calls[0].camera.W), {})
        errors = errors.detach().to(means).contiguous()
    for call in calls:
        call.collecting, call.errors = True, errors

    def found() -> Tensor:
        tables = [call.statistics for call in calls if call.statistics is not None]
        if not tables:
            raise ArgumentError("collect: there is nothing yet; call backward on a loss of this image first")
        total = tables[0].index_select(0, calls[0].visible)
        for table in tables[1:]:  # absgrad accumulates; weights and errors are the same in every pass
            total[:, :2] += table.index_select(0, calls[0].visible)[:, :2]
        return total

    return found


def _collected(call: _Call, means: Tensor) -> Any:  # noqa: ANN401
    """Return the array for the requested statistics of a backward pass; None without a request."""
    if not call.collecting:
        return None
    call.statistics = reusable_tensor((len(means), len(STATISTICS)), means)
    errors = None if call.errors is None else native_array(call.errors)
    return native().Statistics(values=native_array(call.statistics), errors=errors)


def _defer(
    call: _Call, background: Tensor, parameters: Sequence[Tensor]
) -> Callable[[], AdamInBackward] | None:
    """Return `RenderOutput.defer`: for raw parameters that a step can move in place, before a fixed background."""
    movable = all(p.is_leaf and p.requires_grad and p.is_contiguous() for p in parameters)
    if call.direct or background.requires_grad or not movable:
        return None

    def defer() -> AdamInBackward:
        call.deferred = True
        return functools.partial(_adam_in_backward, call)

    return defer


@torch.no_grad()
def _adam_in_backward(call: _Call, moments: Mapping[str, Moments]) -> None:
    """Finish a deferred backward pass: every Gaussian's gradient goes into its moments, and never to memory."""
    if call.waiting is None:
        raise ArgumentError("backward: has not reached this image, or its step has been taken")
    if missing := [name for name in RAW if name not in moments]:
        raise ArgumentError(f"moments: {missing[0]} is missing")
    frame, parameters, images, incoming = call.waiting
    norms = reusable_tensor((len(parameters[0]),), parameters[0])
    groups = {name: _group(parameter, moments[name]) for name, parameter in zip(RAW, parameters, strict=True)}
    collected = _collected(call, parameters[0])
    frame.adam(
        images=images, incoming=incoming, means2d_norm=native_array(norms), collected=collected, **groups
    )
    call.norms, call.waiting = norms, None
    for parameter in parameters:  # one by one: torch 2.4 takes no sequence
        torch.autograd.graph.increment_version(parameter)


def _group(parameter: Tensor, moments: Moments) -> Any:  # noqa: ANN401
    extra = moments.extra
    return native().AdamGroup(
        parameter=native_array(parameter),
        first=native_array(moments.first),
        second=native_array(moments.second),
        extra=None if extra is None else native_array(extra.to(parameter.dtype).contiguous()),
        **moments.numbers._asdict(),
    )


@first_derivative_only("backend 'cpu'", 'backend="torch"')
class _Rasterize(torch.autograd.Function):
    """The complete native renderer as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        call: _Call,
        background: Tensor,
        features: Tensor | None,
        *tensors: Tensor | None,  # the camera's, then the parameters
    ) -> tuple[Tensor, ...]:
        parameters = [tensor for tensor in tensors[POSE:] if tensor is not None]
        camera, means, settings = call.camera, parameters[0], call.settings
        kept = [p.detach().contiguous() for p in parameters]
        given = None if features is None else features.detach().contiguous()
        frame = kernel("FrameF", means.dtype)(
            scene=_scene(kept, call.direct, call.order),
            camera=_camera(camera, settings),
            settings=native().Settings(
                z_near=settings.z_near,
                background=background.tolist(),
                sh_degree=call.sh_degree,
                antialiased=settings.antialiased,
                dilation=settings.dilation,
                alpha_max=settings.alpha_max,
                pixel_stop=settings.stop == "pixel",
            ),
            needed=_array(call.needed),
            threads=torch.get_num_threads(),
        )
        size: tuple[int, ...] = (camera.H, camera.W)
        shapes: tuple[tuple[int, ...], ...] = (
            (*size, 3),
            size,
            size if settings.depth else (0,),
            (0,) if given is None else (*size, given.shape[1]),
            size if settings.median_depth else (0,),
        )
        images = [reusable_tensor(shape, means) for shape in shapes]
        frame.composite(images=_images(*map(_wanted, images)), features=_array(given))
        # Room for all Gaussians: how many are visible changes from view to view, and such buffers would not be reused.
        call.visible = reusable_tensor((len(means),), means, torch.int64)[: frame.num_visible]
        call.radii = reusable_tensor((len(means), 2), means)[: frame.num_visible]
        frame.visible(ids=native_array(call.visible), radii=native_array(call.radii))
        call.num_pairs = frame.num_pairs
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(images[4])
        ctx.call, ctx.frame = call, frame
        ctx.save_for_backward(given, *images, *kept)
        return tuple(images)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        features, *saved = ctx.saved_tensors
        drawn, kept = saved[:5], saved[5:]
        call: _Call = ctx.call
        asked = [
            None if g is None or not im.numel() else g.contiguous()
            for g, im in zip(grads, drawn, strict=True)
        ]
        asked[0] = torch.zeros_like(drawn[0]) if asked[0] is None else asked[0]
        images = _images(*map(_wanted, drawn))
        incoming = _images(*asked[:4], None)
        if call.deferred:
            if call.waiting is not None or call.norms is not None:
                raise ArgumentError("backward: passes a deferred image twice; defer works for one pass")
            call.waiting = _Waiting(ctx.frame, kept, images, incoming)
            return (None,) * (3 + POSE + len(kept))
        outgoing = [reusable_tensor(p.shape, p) for p in kept]
        to_features = None if asked[3] is None else reusable_tensor(features.shape, features)
        norms = reusable_tensor((len(kept[0]),), kept[0])
        background = kept[0].new_empty(3)
        camera = None
        if any(ctx.needs_input_grad[3 : 3 + POSE]):
            camera = torch.empty(gradient_numbers(call.camera), dtype=torch.float64)
        # Saved tensors may have moved since the forward pass, so they are passed again.
        ctx.frame.backward(
            scene=_scene(kept, call.direct),
            images=images,
            incoming=incoming,
            gradients=native().Gradients(
                **_arrays(outgoing, call.direct),
                means2d_norm=native_array(norms),
                background=native_array(background),
                camera=_array(camera),
                features=_array(to_features),
            ),
            features=_array(features),
            collected=_collected(call, kept[0]),
        )
        call.norms = norms if call.norms is None else call.norms + norms
        pose = camera_gradients(camera, ctx.needs_input_grad[3 : 3 + POSE])
        return None, background, to_features, *pose, *outgoing


def _wanted(image: Tensor) -> Tensor | None:
    """Return an image, or None for an empty one: it was not requested."""
    return image if image.numel() else None


def _array(tensor: Tensor | None) -> Any:  # noqa: ANN401
    return None if tensor is None else native_array(tensor)


def _arrays(parameters: list[Tensor], direct: bool) -> dict[str, Any]:
    """Map six raw parameters, or means and three direct ones, to the names in the native structures."""
    return dict(zip(DIRECT if direct else RAW, map(native_array, parameters), strict=True))


def _scene(parameters: list[Tensor], direct: bool, order: Tensor | None = None) -> Any:  # noqa: ANN401
    named = {} if order is None else {"order": native_array(order)}
    return native().Scene(**_arrays(parameters, direct), **named)


def _images(*tensors: Tensor | None) -> Any:  # noqa: ANN401
    names = ("image", "transmittance", "depth", "features", "median")
    return native().Images(**dict(zip(names, map(_array, tensors), strict=True)))


def _camera(camera: Camera, settings: RenderSettings) -> Any:  # noqa: ANN401
    return native_camera(camera, camera.jacobian_bounds(settings.jacobian_limit), not camera.pinhole)

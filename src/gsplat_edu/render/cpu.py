"""The backend cpu: native SIMD kernels behind one autograd function.

    project -> intersect -> composite, and back: composite_backward -> project_backward

The kernels live in `native/`; this module owns the tensors, and hands over addresses of contiguous memory.
Nothing of torch's stands between parameters and gradients, so the gradients are the same to the bit on any
number of threads.

Chapters: 11_tiles, 12_the_backward_pass.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsplat_edu.buffers import empty
from gsplat_edu.camera import Camera
from gsplat_edu.constants import Z_NEAR
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians, check_tensor
from gsplat_edu.kernels import SUFFIXES, kernel
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings


@dataclass
class _Call:
    """What one render needs besides tensors, and what it leaves besides images."""

    camera: Camera
    settings: RenderSettings
    sh_degree: int
    direct: bool
    visible: Tensor = field(init=False)
    radii: Tensor = field(init=False)
    num_pairs: int = field(init=False)
    norms: Tensor | None = None


def render_cpu(
    gaussians: Gaussians, camera: Camera, settings: RenderSettings, background: Tensor
) -> RenderOutput:
    """Render raw parameters; see `gsplat_edu.render.api.render`, which checks them.

    Args:
        gaussians: N Gaussians, float32 or float64, on the CPU.
        camera: The camera.
        settings: The settings.
        background: (3,) colour behind everything, of the Gaussians' dtype.

    Returns:
        The view. Differentiable in every raw parameter and the background.
    """
    call = _Call(camera, settings, min(settings.sh_degree, gaussians.sh_degree), direct=False)
    tensors = gaussians.tensors()
    return _output(call, background, *(tensors[name] for name in RAW))


def render_covariances(
    means: Tensor,
    cov3ds: Tensor,
    colors: Tensor,
    opacities: Tensor,
    camera: Camera,
    settings: RenderSettings | None = None,
    background: Tensor | None = None,
) -> RenderOutput:
    """Render Gaussians given as covariances and colours: what the chapter's dense `render_t` takes.

    Args:
        means: (N, 3) centres, world units.
        cov3ds: (N, 3, 3) covariances, world units squared, symmetric; that they are is not checked here.
        colors: (N, 3) any range.
        opacities: (N,) 0 to 1.
        camera: The camera.
        settings: Background, antialiasing and depth; the defaults where None.
        background: (3,) background as a tensor, to differentiate in; that of the settings where None.

    Returns:
        The view.

    Raises:
        ShapeError: a shape differs, or the arguments have different N.
        ArgumentError: an entry is NaN or infinite, or dtypes are not one of float32 and float64.

    Differentiable in: means, cov3ds, colors, opacities, background. Not in: the camera.
    """
    settings = settings or RenderSettings()
    sizes: dict[str, int] = {}
    check_tensor("means", means, ("N", 3), sizes)
    check_tensor("cov3ds", cov3ds, ("N", 3, 3), sizes)
    check_tensor("colors", colors, ("N", 3), sizes)
    check_tensor("opacities", opacities, ("N",), sizes)
    if background is None:
        background = torch.tensor(settings.background, dtype=means.dtype)
    check_tensor("background", background, (3,), {})
    call = _Call(camera, settings, 0, direct=True)
    return _output(call, background, means, cov3ds, colors, opacities)


RAW = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")
"""Raw parameters in the order in which the kernels take them."""


def _output(call: _Call, background: Tensor, *parameters: Tensor) -> RenderOutput:
    dtype = parameters[0].dtype
    if dtype not in SUFFIXES or any(p.dtype != dtype or p.device.type != "cpu" for p in parameters):
        raise ArgumentError(
            "means: the backend cpu takes float32 or float64 tensors on the CPU, all of one dtype"
        )
    image, transmittance, depth = _Rasterize.apply(call, background, *parameters)  # type: ignore[no-untyped-call]

    def norms() -> Tensor:
        if call.norms is None:
            raise ArgumentError("means2d: has no gradient; call backward on a loss of this image first")
        return call.norms[call.visible]

    depth = depth if call.settings.depth else None
    return RenderOutput(image, transmittance, depth, call.visible, call.radii, call.num_pairs, norms)


class _Rasterize(torch.autograd.Function):
    """The whole of the native renderer as one differentiable step."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        call: _Call,
        background: Tensor,
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        camera, means = call.camera, parameters[0]
        x_bounds, y_bounds = camera.jacobian_bounds(call.settings.jacobian_limit)
        kept = [p.detach().contiguous() for p in parameters]
        frame = kernel("FrameF", means.dtype)(
            len(means),
            0 if call.direct else parameters[4].shape[1],
            _scene(kept, call.direct),
            [
                *camera.R.ravel(),
                *camera.eye,
                camera.fx,
                camera.fy,
                camera.cx,
                camera.cy,
                Z_NEAR,
                *background.tolist(),
                *x_bounds,
                *y_bounds,
            ],
            camera.H,
            camera.W,
            call.sh_degree,
            call.settings.antialiased,
            torch.get_num_threads(),
        )
        image = empty((camera.H, camera.W, 3), means)
        transmittance = empty((camera.H, camera.W), means)
        depth = empty((camera.H, camera.W) if call.settings.depth else (0,), means)
        frame.composite(
            image.data_ptr(), transmittance.data_ptr(), depth.data_ptr() if call.settings.depth else 0
        )
        call.visible = empty((frame.num_visible,), means, torch.int64)
        call.radii = empty((frame.num_visible, 2), means)
        frame.visible(call.visible.data_ptr(), call.radii.data_ptr())
        call.num_pairs = frame.num_pairs
        ctx.set_materialize_grads(False)
        ctx.call, ctx.frame = call, frame
        ctx.save_for_backward(*kept, image, transmittance, depth)
        return image, transmittance, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        *kept, image, transmittance, depth = ctx.saved_tensors
        call: _Call = ctx.call
        incoming = [None if g is None else g.contiguous() for g in grads]
        if incoming[0] is None:
            incoming[0] = torch.zeros_like(image)
        outgoing = [empty(p.shape, p) for p in kept]
        norms = empty((len(kept[0]),), kept[0])
        background = kept[0].new_empty(3)
        # Saved tensors may have been moved since the forward pass: the kernels are told where they are now.
        ctx.frame.backward(
            len(norms),
            0 if call.direct else kept[4].shape[1],
            _scene(kept, call.direct),
            [image.data_ptr(), transmittance.data_ptr(), depth.data_ptr() if call.settings.depth else 0],
            [0 if g is None else g.data_ptr() for g in incoming],
            [*_scene(outgoing, call.direct), norms.data_ptr()],
            background.data_ptr(),
        )
        call.norms = norms if call.norms is None else call.norms + norms
        return None, background, *outgoing


def _scene(parameters: list[Tensor], direct: bool) -> list[int]:
    """List the nine addresses of a native scene: six raw parameters, or means and three direct ones."""
    given = [p.data_ptr() for p in parameters]
    if direct:
        return [given[0], 0, 0, 0, 0, 0, *given[1:]]
    return [*given, 0, 0, 0]

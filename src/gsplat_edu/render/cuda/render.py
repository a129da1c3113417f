"""The backend cuda: Triton kernels behind one autograd function, compiled from Python source without nvcc.

    project -> intersect -> composite, and back: composite_backward -> project_backward

Every sum has a fixed order: pairs write to their own slots and Gaussians add theirs in order, without atomics, so two
runs give the same bits. All launches are on torch's current stream. The host synchronises once per render, for the
numbers of pairs and of visible Gaussians, and once per gradient of a camera. With TRITON_INTERPRET=1 the same kernels
run on CPU tensors.

Where a lens or a rolling shutter sees the Gaussians is a separate operation before project, whose backward pass takes
what project_backward returns (`gsplat_edu.render.cuda.lens`).

Features are composited by the same kernels, in place of colours and depth, four channels per pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.base.constants import TILE
from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.render.camera_tensors import POSE, CameraTensors, camera_gradients, split_camera
from gsplat_edu.render.cuda.composite import composite_backward_kernel, composite_kernel
from gsplat_edu.render.cuda.intersect import count_kernel, emit_kernel
from gsplat_edu.render.cuda.lens import seen_through
from gsplat_edu.render.cuda.project import (
    CAMERA_NUMBERS,
    RECORD,
    SLOT,
    project_backward_kernel,
    project_kernel,
)
from gsplat_edu.render.output import Extra, RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians

BLOCK = 128
"""Gaussians per program of project, count and emit."""

BACKWARD_BLOCK = 64
"""Gaussians per program of project_backward, which keeps many values of each."""

BATCH = 16
"""Gaussians per step of composite: the minimum for matrix units."""

PRECISION = "ieee"
"""Precision of composite's matrix product: full float32; tf32x3 and tf32 are faster and less accurate."""

COMPOSITE_BACKWARD_WARPS, PROJECT_BACKWARD_WARPS = 8, 2
"""Warps per program, chosen so that triton 3.6 and 3.9 keep all values in registers."""

RAW = ("means", "quats", "log_scales", "sh0", "sh_rest", "logit_opacities")
"""Raw parameters in the kernels' argument order."""

GROUP = 4
"""Features per pass: composite has room for three colours and a depth."""

camera_rows: WeakKeyDictionary[Camera, dict[tuple[str, float | None, float], Tensor]] = WeakKeyDictionary()


@dataclass
class _Call:
    """State of one render: non-tensor inputs and non-image outputs."""

    camera: Camera
    settings: RenderSettings
    sh_degree: int
    lens: bool
    optics: int  # LENS of the kernels: 0 for a pinhole at rest, 2 for a camera with an exposure, 1 for others
    visible: Tensor = field(init=False)
    radii: Tensor = field(init=False)
    num_pairs: int = field(init=False)
    norms: Tensor | None = None

    @property
    def wraps(self) -> bool:
        """Whether the left and right edges of the image meet."""
        return self.camera.projection.kind == "equirectangular"


@dataclass(frozen=True)
class _Lists:
    """Records of all Gaussians, and the pairs of every tile, near to far."""

    records: Tensor
    pairs_of: Tensor
    slot_begin: Tensor
    gaussians: Tensor
    slots: Tensor
    tile_begin: Tensor


def render_triton(
    gaussians: Gaussians, camera: Camera | CameraTensors, settings: RenderSettings, extra: Extra
) -> RenderOutput:
    """Render raw parameters; `gsplat_edu.render.api.render` validates the arguments.

    Args:
        gaussians: N Gaussians, float32, on the GPU; on the CPU under Triton's interpreter.
        camera: The camera.
        settings: The settings.
        extra: Background and features, of the Gaussians' dtype and device.

    Returns:
        The view. Differentiable in every raw parameter, background, features and a camera of tensors.

    Raises:
        ArgumentError: the Gaussians or the features are not float32, or are on different devices.
    """
    features, means = extra.features, gaussians.means
    if means.dtype != torch.float32:
        raise ArgumentError(f"means: are {means.dtype}, but the backend cuda needs float32")
    if features is not None and (features.dtype, features.device) != (means.dtype, means.device):
        raise ArgumentError(
            f"features: are {features.dtype} on {features.device}, but the Gaussians are float32 on {means.device}"
        )
    value, pose = split_camera(camera)
    lens, degree = not camera.pinhole, min(settings.sh_degree, gaussians.sh_degree)
    call = _Call(value, settings, degree, lens, lens + (value.exposure > 0))
    tensors = gaussians.tensors()
    parameters = [tensors[name] for name in RAW]
    with torch.cuda.device_of(gaussians.means):  # type: ignore[no-untyped-call]
        seen = None
        if call.lens:
            seen = seen_through(means, camera, settings.z_near, jacobian_limit=settings.jacobian_limit)
        camera_parts = (None,) * POSE if call.lens else pose  # a lens has its gradients through `seen`
        image, transmittance, depth, mixed, median = _Rasterize.apply(  # type: ignore[no-untyped-call]
            call, extra.background, features, seen, *camera_parts, *parameters
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
        features=None if features is None else mixed,
        median_depth=median if settings.median_depth else None,
    )


@first_derivative_only("backend 'cuda'", 'backend="torch"')
class _Rasterize(torch.autograd.Function):
    """The complete renderer as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        call: _Call,
        background: Tensor,
        features: Tensor | None,
        seen: Tensor | None,
        *tensors: Tensor | None,  # the camera's, then the parameters
    ) -> tuple[Tensor, ...]:
        parameters = [tensor for tensor in tensors[POSE:] if tensor is not None]
        settings = call.settings
        kept = [p.detach().contiguous() for p in parameters]
        given_seen = None if seen is None else seen.detach()
        lists = _intersect(call, _project(call, kept, given_seen))
        shown = _composite(
            call, lists, background.detach().contiguous(), settings.depth, settings.median_depth
        )
        image, transmittance, depth, median = shown
        mixed, given = background.new_empty(0), None
        if features is not None:
            given = features.detach()
            mixed = _composite_features(call, lists, given)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(median)
        ctx.call, ctx.lists = call, lists
        ctx.save_for_backward(given, given_seen, mixed, image, transmittance, depth, *kept)
        return image, transmittance, depth, mixed, median

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        features, seen, mixed, image, transmittance, depth, *kept = ctx.saved_tensors
        call: _Call = ctx.call
        lists: _Lists = ctx.lists
        grad_image, grad_T, grad_depth, grad_mixed, _ = (None if g is None else g.contiguous() for g in grads)
        grad_image = torch.zeros_like(image) if grad_image is None else grad_image
        grad_depth = grad_depth if call.settings.depth else None
        slots = _composite_backward(
            call, lists, (image, transmittance, depth), (grad_image, grad_T, grad_depth)
        )
        to_features = None
        if grad_mixed is not None and features is not None:
            to_features = _features_backward(call, lists, (features, mixed, transmittance), grad_mixed, slots)
        wanted_pose = ctx.needs_input_grad[4 : 4 + POSE]
        outgoing, camera_sums = _project_backward(call, lists, kept, seen, slots, any(wanted_pose))
        wanted = ctx.needs_input_grad[1]
        background = (grad_image * transmittance[..., None]).sum(dim=(0, 1)) if wanted else None
        pose = camera_gradients(None if camera_sums is None else camera_sums.cpu(), wanted_pose)
        to_seen = outgoing[0] if call.lens else None
        to_means = None if call.lens else outgoing[0]
        return None, background, to_features, to_seen, *pose, to_means, *outgoing[1:]


def _composite(
    call: _Call, lists: _Lists, background: Tensor, with_depth: bool, with_median: bool
) -> tuple[Tensor, ...]:
    """Return image, transmittance, depth and median depth; those that are not wanted are empty."""
    camera, (tiles_x, tiles) = call.camera, _grid(call.camera)
    size = (camera.H, camera.W)
    shapes = (*size, 3), size, size if with_depth else (0,), size if with_median else (0,)
    images = tuple(background.new_empty(shape) for shape in shapes)
    composite_kernel[(tiles,)](
        lists.records, lists.gaussians, lists.tile_begin, background, *images, camera.W, camera.H, tiles_x,
        math.log2(call.settings.alpha_max),
        WITH_DEPTH=with_depth, WITH_MEDIAN=with_median, WRAPS=call.wraps, BATCH=BATCH, PRECISION=PRECISION,
    )  # fmt: skip
    return images


def _composite_backward(
    call: _Call, lists: _Lists, images: tuple[Tensor, ...], grads: tuple[Tensor, Tensor | None, Tensor | None]
) -> Tensor:
    """Return the slots of all pairs. Images and gradients: image, transmittance, depth."""
    image, (grad_image, grad_T, grad_depth) = images[0], grads
    slots = image.new_zeros(max(len(lists.gaussians), 1), SLOT.value)
    tiles_x, tiles = _grid(call.camera)
    composite_backward_kernel[(tiles,)](
        lists.records, lists.gaussians, lists.slots, lists.tile_begin, *images,
        grad_image, image if grad_T is None else grad_T, image if grad_depth is None else grad_depth, slots,
        call.camera.W, call.camera.H, tiles_x, math.log2(call.settings.alpha_max),
        WITH_T=grad_T is not None, WITH_DEPTH=grad_depth is not None, WRAPS=call.wraps, BATCH=BATCH,
        num_warps=COMPOSITE_BACKWARD_WARPS,
    )  # fmt: skip
    return slots


def _with_group(lists: _Lists, features: Tensor, first: int) -> _Lists:
    """Return the lists with a group of features in place of colours and depth; missing ones are 0."""
    records = lists.records.clone()
    group = features[:, first : first + GROUP]
    records[:, 6:10] = torch.nn.functional.pad(group, (0, GROUP - group.shape[1]))
    return replace(lists, records=records)


def _composite_features(call: _Call, lists: _Lists, features: Tensor) -> Tensor:
    """Composite features over zero, a group at a time."""
    black = features.new_zeros(3)
    groups = []
    for first in range(0, features.shape[1], GROUP):
        image, _, depth, _ = _composite(call, _with_group(lists, features, first), black, True, False)
        groups.append(torch.cat([image, depth[..., None]], dim=2))
    return torch.cat(groups, dim=2)[..., : features.shape[1]].contiguous()


def _features_backward(
    call: _Call, lists: _Lists, drawn: tuple[Tensor, Tensor, Tensor], gradient: Tensor, slots: Tensor
) -> Tensor:
    """Return the gradient of the features, and add their share of the moments to the slots of all pairs.

    Args:
        call: The render.
        lists: Its lists.
        drawn: Features, their image, and the transmittance.
        gradient: (H, W, C) gradient of that image.
        slots: Slots of all pairs.
    """
    features, mixed, transmittance = drawn
    channels = features.shape[1]
    sums = []
    for first in range(0, channels, GROUP):
        padding = (0, first + GROUP - channels if first + GROUP > channels else 0)
        image, incoming = (
            torch.nn.functional.pad(each[..., first : first + GROUP], padding) for each in (mixed, gradient)
        )
        images = (image[..., :3].contiguous(), transmittance, image[..., 3].contiguous())
        grads = (incoming[..., :3].contiguous(), None, incoming[..., 3].contiguous())
        own = _composite_backward(call, _with_group(lists, features, first), images, grads)
        slots[:, GROUP:] += own[:, GROUP:]
        sums.append(own[:, :GROUP])
    pairs = torch.cat(sums, dim=1)[: len(lists.gaussians), :channels].contiguous()
    found = torch.zeros_like(features)
    if len(pairs):
        # The slots of a Gaussian are neighbours, and `segment_reduce` adds them one after another.
        by_slot = torch.sort(lists.slot_begin, stable=True).indices
        by_slot = by_slot[lists.pairs_of[by_slot] > 0]
        lengths = lists.pairs_of[by_slot].to(torch.int64)
        found[by_slot] = torch.segment_reduce(pairs, "sum", lengths=lengths, axis=0)
    return found


def _project(call: _Call, kept: list[Tensor], seen: Tensor | None) -> Tensor:
    count = len(kept[0])
    records = kept[0].new_empty(count, RECORD.value)
    if count:
        project_kernel[(-(-count // BLOCK),)](
            *kept, camera_row(call, kept[0].device), records if seen is None else seen, records, count,
            DEGREE=call.sh_degree, REST=kept[4].shape[1], ANTIALIASED=call.settings.antialiased,
            DILATION=call.settings.dilation, LENS=call.optics, WRAPS=call.wraps, BLOCK=BLOCK,
        )  # fmt: skip
    return records


def _project_backward(
    call: _Call, lists: _Lists, kept: list[Tensor], seen: Tensor | None, slots: Tensor, with_camera: bool
) -> tuple[list[Tensor], Tensor | None]:
    """Return the gradients of the parameters, and the camera's numbers in float64; set the norms of the call.

    Args:
        call: The render.
        lists: Its lists.
        kept: Raw parameters.
        seen: What the lens has seen; its gradient takes the place of that of the means. None for a pinhole.
        slots: Slots of all pairs.
        with_camera: Whether a pinhole's gradient is wanted.
    """
    count = len(kept[0])
    blocks = -(-count // BACKWARD_BLOCK)
    outgoing = [torch.empty_like(p) for p in kept]  # fully overwritten
    if seen is not None:
        outgoing[0] = torch.zeros_like(seen)  # its rows are padded
    norms = kept[0].new_zeros(count)
    camera_sums = kept[0].new_empty(blocks if with_camera else 0, CAMERA_NUMBERS.value)
    if count:
        project_backward_kernel[(blocks,)](
            *kept, camera_row(call, slots.device), slots if seen is None else seen, slots, lists.slot_begin,
            lists.pairs_of, *outgoing, norms, camera_sums, count,
            DEGREE=call.sh_degree, REST=kept[4].shape[1], ANTIALIASED=call.settings.antialiased,
            DILATION=call.settings.dilation, WITH_CAMERA=with_camera, LENS=call.optics, BLOCK=BACKWARD_BLOCK,
            num_warps=PROJECT_BACKWARD_WARPS,
        )  # fmt: skip
    call.norms = norms if call.norms is None else call.norms + norms
    return outgoing, camera_sums.double().sum(dim=0) if with_camera else None


def _intersect(call: _Call, records: Tensor) -> _Lists:
    """Sort by depth, count and write the pairs in that order, and stably sort them by tile."""
    camera, count, device = call.camera, len(records), records.device
    tiles_x, tiles = _grid(camera)
    seen = records[:, 10] > 0
    order = torch.sort(torch.where(seen, records[:, 9], torch.inf), stable=True).indices
    pairs_of = torch.zeros(count, dtype=torch.int32, device=device)
    blocks = (-(-count // BLOCK),)
    if count:
        count_kernel[blocks](records, pairs_of, count, camera.W, camera.H, WRAPS=call.wraps, BLOCK=BLOCK)
    ends = torch.cumsum(pairs_of[order], dim=0, dtype=torch.int64)
    begin = torch.empty_like(ends)
    begin[order] = ends - pairs_of[order]
    totals = torch.stack([pairs_of.sum(dtype=torch.int64), seen.sum()])
    call.num_pairs, num_visible = totals.tolist()  # the only synchronisation of the host
    call.visible = order[:num_visible]
    call.radii = records[call.visible, 10:12]
    # the two kernels may round differently: a pair that is counted and not written belongs to no tile
    tile_of = torch.full((call.num_pairs,), tiles, dtype=torch.int32, device=device)
    gaussians = torch.zeros_like(tile_of)
    if call.num_pairs:
        emit_kernel[blocks](
            records,
            order,
            begin,
            pairs_of,
            tile_of,
            gaussians,
            count,
            camera.W,
            camera.H,
            tiles_x,
            WRAPS=call.wraps,
            BLOCK=BLOCK,
        )
    tile_of, slots = torch.sort(tile_of, stable=True)
    edges = torch.arange(tiles + 1, dtype=torch.int32, device=device)
    tile_begin = torch.searchsorted(tile_of, edges).to(torch.int32)
    return _Lists(records, pairs_of, begin, gaussians[slots], slots, tile_begin)


def _grid(camera: Camera) -> tuple[int, int]:
    """Return the number of tiles per row, and in total."""
    tiles_x = -(-camera.W // TILE)
    return tiles_x, tiles_x * -(-camera.H // TILE)


def camera_row(call: _Call, device: torch.device) -> Tensor:
    """Return the camera on the device: R, eye, f, c, size, bounds of x/z and y/z, near plane, remainder of eye.

    They are cached with the camera, so that later renders copy nothing.
    """
    camera, key = call.camera, (str(device), call.settings.jacobian_limit, call.settings.z_near)
    rows = camera_rows.setdefault(camera, {})
    if key not in rows:
        x_bounds, y_bounds = camera.jacobian_bounds(call.settings.jacobian_limit)
        numbers = [
            *camera.R.ravel(),
            *camera.eye,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            camera.W,
            camera.H,
        ]
        rest = camera.eye - camera.eye.astype(np.float32)  # rounding error of float32
        rows[key] = torch.tensor(
            [*numbers, *x_bounds, *y_bounds, call.settings.z_near, *rest], dtype=torch.float32, device=device
        )
    return rows[key]

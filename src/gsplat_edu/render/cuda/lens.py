"""Where a lens or a rolling shutter sees Gaussians: the kernels of `sight` as a differentiable operation.

The kernels of project take the result in place of a pinhole's projection.
"""

from __future__ import annotations

import math
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.render.camera_tensors import (
    POSE,
    CameraTensors,
    camera_gradients,
    split_camera,
)
from gsplat_edu.render.cuda.lens_formulas import (
    BLURRED,
    BOUNDED,
    BY_COLUMNS,
    DISTORTED,
    MOVING,
    RADIAL_FIRST,
)
from gsplat_edu.render.cuda.sight import LENS_NUMBERS, SEEN, sight_backward_kernel, sight_kernel
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.projection import COEFFICIENTS
from gsplat_edu.scene.shutter import MOTION_NUMBERS, readout_axis, readout_pace

BLOCK = 64
"""Gaussians per program, which keeps many values of each."""

WARPS = 2
"""Warps per program: a thread for each Gaussian."""

NUMBERS = {"perspective": 0, "fisheye": 1, "equirectangular": 2, "orthographic": 3}
"""The kernels' numbers of the projections."""

_lens_rows: WeakKeyDictionary[Camera, dict[tuple[str, torch.dtype, float, float | None], Tensor]] = (
    WeakKeyDictionary()
)


def seen_through(
    means: Float[Tensor, "N 3"],
    camera: Camera | CameraTensors,
    z_near: float,
    dtype: torch.dtype = torch.float32,
    jacobian_limit: float | None = None,
) -> Float[Tensor, "N 16"]:
    """Return where a camera sees the means, as the kernels of project read it; zeros where it sees none.

    Args:
        means: (N, 3) world units.
        camera: The camera.
        z_near: Smallest depth, world units.
        dtype: The type in which the kernels compute.
        jacobian_limit: As for `Camera.jacobian_bounds`.

    Returns:
        (N, 16), differentiable in the means and in a camera of tensors.
    """
    value, pose = split_camera(camera)
    optics = _optics(value)
    if jacobian_limit is not None and value.projection.kind == "perspective":
        optics += BOUNDED.value
    row = _lens_row(value, z_near, jacobian_limit, means.device, dtype)
    seen: Tensor = _Sight.apply(row, optics, *pose, means)  # type: ignore[no-untyped-call]
    return seen


@first_derivative_only("backend 'cuda'", 'backend="torch"')
class _Sight(torch.autograd.Function):
    """The kernels of `sight`, forward and backward."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        row: Tensor,
        optics: int,
        *tensors: Tensor | None,  # the camera's, then the means
    ) -> Tensor:
        means = tensors[POSE]
        assert means is not None
        given = means.detach().contiguous()
        seen = torch.zeros(len(given), SEEN.value, dtype=row.dtype, device=row.device)
        if len(given):
            sight_kernel[(-(-len(given) // BLOCK),)](
                given, row, seen, len(given), OPTICS=optics, BLOCK=BLOCK, num_warps=WARPS
            )
        ctx.optics = optics
        ctx.save_for_backward(given, row, seen)
        return seen

    @staticmethod
    def backward(ctx: Any, grad_seen: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        means, row, seen = ctx.saved_tensors
        wanted = ctx.needs_input_grad[2 : 2 + POSE]
        blocks, with_camera = -(-len(means) // BLOCK), any(wanted)
        grad_means = torch.empty_like(means)  # fully overwritten
        sums = row.new_zeros(2 * blocks if with_camera else 0, LENS_NUMBERS.value)
        if blocks:
            sight_backward_kernel[(blocks,)](
                means, row, seen, grad_seen.contiguous(), grad_means, sums, len(means),
                OPTICS=ctx.optics, WITH_CAMERA=with_camera, BLOCK=BLOCK, num_warps=WARPS,
            )  # fmt: skip
        pose = camera_gradients(sums.double().sum(dim=0).cpu() if with_camera else None, wanted)
        return None, None, *pose, grad_means


def _optics(camera: Camera) -> int:
    """Return the kernels' number of a kind of camera; see `gsplat_edu.render.cuda.lens_formulas`."""
    number = NUMBERS[camera.projection.kind]
    number += DISTORTED.value * (camera.coefficients is not None)
    number += RADIAL_FIRST.value * camera.projection.radial_first
    number += MOVING.value * (camera.motion is not None)
    number += BLURRED.value * (camera.exposure > 0)
    return int(number + BY_COLUMNS.value * (readout_axis(camera.readout) == 0))


def _lens_row(
    camera: Camera, z_near: float, limit: float | None, device: torch.device, dtype: torch.dtype
) -> Tensor:
    """Return the camera on the device, cached with it; `gsplat_edu.render.cuda.sight` has the places."""
    rows = _lens_rows.setdefault(camera, {})
    key = (str(device), dtype, z_near, limit)
    if key not in rows:
        bound = {"perspective": math.tan(camera.widest) ** 2, "fisheye": math.cos(camera.widest)}
        size = (camera.W, camera.H)[readout_axis(camera.readout)]
        rest = camera.eye - camera.eye.astype(np.float32 if dtype == torch.float32 else np.float64)
        numbers = [
            *camera.R.ravel(),
            *camera.eye,
            *(camera.fx, camera.fy, camera.cx, camera.cy),
            *(camera.coefficients or (0.0,) * len(COEFFICIENTS)),
            *(camera.motion or (0.0,) * MOTION_NUMBERS),
            bound.get(camera.projection.kind, 0.0),
            readout_pace(camera.readout, camera.H, camera.W),
            (size - 1) / 2,
            z_near,
            *rest,
            *(bound for bounds in camera.jacobian_bounds(limit) for bound in bounds),
            camera.exposure / math.sqrt(12.0),
        ]
        rows[key] = torch.tensor(numbers, dtype=dtype, device=device)
    return rows[key]

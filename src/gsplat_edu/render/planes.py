"""Gaussians as planes: normals and distances, and features that composite to planar depth and distortion.

A Gaussian stands for the plane  n . (x - mean) = 0  through its mean, whose normal n is its shortest axis. A ray r of
camera depth 1 from the eye meets it at the depth  d / (n . r),  d = n . (mean - eye). With the weights w of a pixel,

    planar depth = sum w d / (sum w n . r)
    distortion = sum_{i<j} w_i w_j (z_i - z_j)² = A sum w z² - (sum w z)²,   A = sum w

Planar depth is exact where all Gaussians of a pixel lie in one plane, however oblique; the depth of the means is not.
Source: Chen et al. 2024 (PGSR), section 4.1; Huang et al. 2024 (2DGS), eq. 13.

Chapter: 15_cloud_to_surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from gsplat_edu.base.buffers import reusable_tensor
from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.threads import native_threads
from gsplat_edu.ops.kernels import SUFFIXES, kernel, native_array
from gsplat_edu.render.torch.sight import seen_by
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussians import Gaussians, unchecked_rotations

PLANE_CHANNELS = 4
"""Channels of `plane_features`."""

FAR_BEHIND = 1e6
"""World units behind an orthographic camera from where its parallel rays come, for the side of a normal."""


def facing_normals(gaussians: Gaussians, camera: CameraLike) -> Float[Tensor, "N 3"]:
    """Return each Gaussian's shortest axis, turned towards the camera. For a sphere it is one of three arbitrary ones.

    Args:
        gaussians: N Gaussians.
        camera: A `Camera` or any object with its members.

    Returns:
        (N, 3) unit vectors in world axes; zero for a Gaussian whose rotation is undefined.

    Raises:
        ArgumentError: `camera` is invalid.

    Differentiable in: quats. Which axis is the shortest, and its sign, are constants.
    """
    eye = _seen_from(as_camera("camera", camera))
    means, quats, log_scales = gaussians.means, gaussians.quats, gaussians.log_scales
    if means.device.type != "cpu" or means.dtype not in SUFFIXES:
        return facing_normals_in_torch(gaussians, eye)
    found: Tensor = _Normals.apply(means, quats, log_scales, eye)  # type: ignore[no-untyped-call]
    return found


def _seen_from(camera: Camera) -> Float64[np.ndarray, "3"]:
    """Return where the camera sees from: its centre, or a place far behind that of an orthographic one."""
    if camera.projection.kind == "orthographic":
        return np.asarray(camera.eye - FAR_BEHIND * camera.R[2])
    return camera.eye


def facing_normals_in_torch(gaussians: Gaussians, eye: Float64[np.ndarray, "3"]) -> Float[Tensor, "N 3"]:
    """Return `facing_normals` for a camera at `eye` from their definition, by torch's operations, on any device."""
    at = torch.tensor(eye).to(gaussians.means)
    shortest = gaussians.log_scales.detach().argmin(dim=-1)
    rotations = unchecked_rotations(gaussians.quats)
    axes = rotations.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    axes = axes.where(axes.detach().isfinite(), 0.0)
    away = ((gaussians.means - at) * axes).sum(dim=-1, keepdim=True).detach() > 0
    return torch.where(away, -axes, axes)


def plane_features(gaussians: Gaussians, camera: CameraLike) -> Float[Tensor, "N 4"]:
    """Return each Gaussian's plane as features to composite: its normal (world axes), and its distance from the eye.

    (n, d),  n: `facing_normals`,  d = n . (mean - eye), at most 0

    Args:
        gaussians: N Gaussians.
        camera: A `Camera` or any object with its members.

    Returns:
        (N, 4); zero for a Gaussian whose rotation is undefined.

    Raises:
        ArgumentError: `camera` is invalid.

    Differentiable in: means, quats. Which axis is the shortest, its sign, and the camera are constants.
    """
    camera = as_camera("camera", camera)
    eye = torch.tensor(camera.eye).to(gaussians.means)
    normals = facing_normals(gaussians, camera)
    distances = ((gaussians.means - eye) * normals).sum(dim=-1, keepdim=True)
    return torch.cat([normals, distances], dim=-1)


def distortion_features(gaussians: Gaussians, camera: CameraLike) -> Float[Tensor, "N 2"]:
    """Return (z - m, (z - m)²) with the depths z of the means and the median m of those in front of the camera.

    Depths are distances for a projection that is `along_ray`.

    The distortion does not depend on m. Subtracting m keeps digits in float32, because A M2 - M1² cancels.

    Args:
        gaussians: N Gaussians.
        camera: A `Camera` or any object with its members.

    Raises:
        ArgumentError: `camera` is invalid.

    Differentiable in: means. m and the camera are constants.
    """
    camera = as_camera("camera", camera)
    depths = _camera_depths(gaussians.means, camera)
    ahead = depths.detach()[depths.detach() > 0]
    offset = depths - (ahead.median() if len(ahead) else 0.0)
    return torch.stack([offset, offset * offset], dim=-1)


def depth_features(gaussians: Gaussians, camera: Camera, counted: Bool[Tensor, " N"]) -> Float[Tensor, "N 2"]:
    """Return (z, 1) for the Gaussians that count, and (0, 0) for the others, with the depths z of the means.

    They composite to the depth and the alpha of those that count, behind whatever lies in front of them.

    Args:
        gaussians: N Gaussians.
        camera: A camera of any projection, with or without a shutter.
        counted: (N,) which count. One whose mean is not finite never does.

    Differentiable in: means. The camera is a constant.
    """
    means = gaussians.means
    counted = counted & means.detach().isfinite().all(dim=1)
    if camera.motion is not None:
        with torch.no_grad():
            counted = counted & seen_by(means, camera, 0.0).valid
    rows = torch.nonzero(counted)[:, 0]
    some = means.index_select(0, rows)
    depths = some.new_zeros(len(means)).index_put((rows,), _depths_of(some, camera))
    return torch.stack([depths, counted.to(means)], dim=1)


def _depths_of(means: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, " N"]:
    """Return the depths of finite means that the camera sees; by one operation at a time, so that no thread matters."""
    if camera.motion is not None:
        seen: Tensor = seen_by(means, camera, 0.0).depth
        return seen
    x, y, z = (means - torch.tensor(camera.eye).to(means)).unbind(dim=1)
    if camera.projection.along_ray:
        return (x * x + y * y + z * z).sqrt()
    forward = camera.R[2].tolist()
    along: Tensor = x * forward[0] + y * forward[1] + z * forward[2]
    return along


def _camera_depths(means: Float[Tensor, "N 3"], camera: Camera) -> Float[Tensor, " N"]:
    eye, forward = (torch.tensor(v).to(means) for v in (camera.eye, camera.R[2]))
    if camera.projection.along_ray:
        distances: Tensor = torch.linalg.vector_norm(means - eye, dim=-1)
        return distances
    return ((means - eye) * forward).sum(dim=-1)


@first_derivative_only("facing_normals", "facing_normals_in_torch")
class _Normals(torch.autograd.Function):
    """The normals of all Gaussians, natively; the same bits for any number of threads."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, log_scales: Tensor, eye: np.ndarray) -> Tensor:  # noqa: ANN401
        given = [tensor.detach().contiguous() for tensor in (means, quats, log_scales)]
        out = reusable_tensor((len(means), 3), means)
        kernel("normals_f", means.dtype)(**_arguments(given, eye), out=native_array(out))
        ctx.save_for_backward(*given)
        ctx.eye = eye
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        given = ctx.saved_tensors
        gradient = reusable_tensor(given[1].shape, given[1])
        kernel("normals_backward_f", grad.dtype)(
            **_arguments(given, ctx.eye),
            grad=native_array(grad.contiguous()),
            grad_quats=native_array(gradient),
        )
        return None, gradient, None, None


def _arguments(given: Sequence[Tensor], eye: np.ndarray) -> dict[str, Any]:
    means, quats, log_scales = map(native_array, given)
    return {
        "means": means,
        "quats": quats,
        "log_scales": log_scales,
        "eye": eye.tolist(),
        "threads": native_threads(),
    }

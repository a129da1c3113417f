"""Surfaces in images: planar depth, the normals of a depth map, and how far composited normals are from them.

Chapter: 15_cloud_to_surface.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.buffers import reusable_tensor
from gsplat_edu.base.derivatives import chained, first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import native_threads, one_thread
from gsplat_edu.base.validation import check_shape, in_range
from gsplat_edu.ops.kernels import SUFFIXES, kernel, native_array
from gsplat_edu.ops.lenses import native_rays
from gsplat_edu.scene.camera import Camera

GRAZE = 0.02
"""Smallest |cos| between a plane's normal and the ray for which the plane has a depth: 88.9 degrees. Nearer to edge-on,
the depth's error grows without bound."""

JUMP = 0.05
"""Largest difference of depth within a pixel's four neighbours, as a fraction of the nearest: beyond it, they lie on
different surfaces. With a focal length of 300 px, a plane reaches it at 82 degrees."""


def planar_depth(planes: Float[Tensor, "H W 4"], rays: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W"]:
    """Return the camera depth at which each pixel's ray meets the composited plane: z = D / (N . r).

    Args:
        planes: (H, W, 4) composited `plane_features`.
        rays: (H, W, 3) world rays of camera depth 1 (`Camera.rays`), of the planes' dtype.

    Returns:
        (H, W) world units; 0 where nothing is, or the plane is seen from behind or edge-on (`GRAZE`).

    Differentiable in: planes.
    """
    check_shape("rays", rays.shape, (*planes.shape[:2], 3), {})
    normal, distance = planes[..., :3], planes[..., 3]
    slope = (normal * rays).sum(dim=-1)
    squared = (normal * normal).sum(dim=-1) * (rays * rays).sum(dim=-1)
    held = (slope < 0) & (distance < 0) & (slope * slope > GRAZE**2 * squared)
    # where() twice keeps the division by 0 out of the chain rule.
    return torch.where(held, distance / torch.where(held, slope, 1.0), 0.0)


def normals_of_depth(
    depth: Float[Tensor, "H W"],
    rays: Float[Tensor, "H W 3"],
    origins: Float[Tensor, "H W 3"] | None = None,
    wraps: bool = False,
) -> Float[Tensor, "H W 3"]:
    """Return the normals of a depth map by central differences, towards the camera.

    m = ty x tx,  tx = P(u + 1) - P(u - 1),  ty = P(v + 1) - P(v - 1),  P = o + z r

    Args:
        depth: (H, W) camera depth, world units; 0 where there is none.
        rays: (H, W, 3) world rays of camera depth 1, of the depth's dtype.
        origins: (H, W, 3) where rays begin, world units, less any constant; None if all begin at one point.
        wraps: Whether the first and the last column are neighbours (`Projection.wraps`), so that they are no border.

    Returns:
        (H, W, 3) unit vectors in world axes; 0 on the border, where one of the four neighbours has no depth, and where
        their depths differ by more than `JUMP`.

    Differentiable in: depth.
    """
    points = depth[..., None] * rays if origins is None else origins + depth[..., None] * rays
    if wraps:
        points, depth = (torch.cat([t[:, -1:], t, t[:, :1]], dim=1) for t in (points, depth))
    along_u, along_v = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normals = torch.linalg.cross(along_v, along_u)
    around = torch.stack([depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1]])
    nearest, farthest = around.amin(dim=0), around.amax(dim=0)
    squared = (normals * normals).sum(dim=-1)
    held = (nearest > 0) & (farthest < (1 + JUMP) * nearest) & (squared > 0)
    length = torch.where(held, squared, 1.0).sqrt()
    inner = torch.where(held[..., None], normals / length[..., None], 0.0)
    beside = 0 if wraps else 1
    return torch.nn.functional.pad(inner, (0, 0, beside, beside, 1, 1))


def check_maps(normals: Tensor, depth: Tensor, alpha: Tensor, camera: Camera) -> None:
    """Check the maps of a camera's surface: normals (H, W, 3), depth and alpha (H, W), of one dtype and device.

    Raises:
        ShapeError: a size differs from the camera's.
        ArgumentError: dtypes or devices differ.
    """
    check_shape("normals", normals.shape, (camera.H, camera.W, 3), {})
    for name, given in (("depth", depth), ("alpha", alpha)):
        check_shape(name, given.shape, (camera.H, camera.W), {})
        if (given.dtype, given.device) != (normals.dtype, normals.device):
            wanted = f"{normals.dtype} on {normals.device}"
            raise ArgumentError(f"{name}: is {given.dtype} on {given.device}, but normals are {wanted}")


def normal_error(
    normals: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    camera: Camera,
    weight: float = 1.0,
) -> Float[Tensor, ""]:
    """Return how far composited normals are from those of the mean depth: weight mean_pixels a (a - N . m).

    m is the normal of `normals_of_depth` of the mean depth, sum w z / a; pixels without one add 0. The factors a are
    constants. The value is 0 where the splats of an opaque surface lie in it; splats of a pixel that disagree shorten N
    and raise it. Through a lens, depth is that of its projection (`Projection.along_ray`), and a pixel without a ray
    has none. Behind a rolling shutter, rays begin where the camera is when their pixel is read. The first and the last
    column of a panorama are neighbours.

    Args:
        normals: (H, W, 3) composited `gsplat_edu.render.planes.facing_normals`.
        depth: (H, W) sum of w z, world units.
        alpha: (H, W) accumulated alpha.
        camera: The camera. Of an orthographic one, torch's operations compute the value.
        weight: Factor of the value.

    Returns:
        () scalar, differentiable in normals, depth and alpha; the same bits for any number of threads on the CPU.

    Raises:
        ShapeError: the sizes differ.
        ArgumentError: the weight is negative, or dtypes or devices differ.

    Source: Huang et al. 2024 (2DGS), eq. 14.
    """
    check_maps(normals, depth, alpha, camera)
    in_range("weight", weight, 0.0)
    if normals.device.type != "cpu" or normals.dtype not in SUFFIXES or _parallel(camera):
        return normal_error_in_torch(normals, depth, alpha, camera, weight)
    value: Tensor = _NormalError.apply(normals, depth, alpha, camera, weight)  # type: ignore[no-untyped-call]
    return value


def _parallel(camera: Camera) -> bool:
    """Whether a camera's rays begin on a plane, which the native kernels do not know."""
    return camera.projection.kind == "orthographic"


@one_thread()  # the rounding of torch's sum depends on the number of threads
def normal_error_in_torch(
    normals: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    camera: Camera,
    weight: float = 1.0,
) -> Float[Tensor, ""]:
    """Return `normal_error` from its definition, by torch's operations, on any device."""
    own = camera.rays()
    seen = np.isfinite(own).all(axis=-1)
    rays = torch.from_numpy(np.where(seen[..., None], own, 0.0)).to(normals)
    away = None if camera.pinhole else torch.from_numpy(camera.origins() - camera.eye).to(normals)
    drawn = alpha > 0
    mean_depth = (depth / alpha.where(drawn, 1.0)).where(drawn & torch.from_numpy(seen).to(drawn.device), 0.0)
    given = normals_of_depth(mean_depth, rays, away, camera.projection.wraps)
    a = alpha.detach() * (given.detach() != 0).any(dim=-1)
    agreement = (normals * given).sum(dim=-1)
    return weight * (a * (a - agreement)).sum() / (camera.H * camera.W)


@first_derivative_only("normal_error", "normal_error_in_torch")
class _NormalError(torch.autograd.Function):
    """Compute value and gradients in one native call; backward only scales."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        normals: Tensor,
        depth: Tensor,
        alpha: Tensor,
        camera: Camera,
        weight: float,
    ) -> Tensor:
        given = [tensor.detach().contiguous() for tensor in (normals, depth, alpha)]
        gradients = [reusable_tensor(tensor.shape, tensor) for tensor in given]
        names = ("normals", "depth", "alpha")
        value = kernel("surface_f", normals.dtype)(
            **{name: native_array(tensor) for name, tensor in zip(names, given, strict=True)},
            **{f"grad_{name}": native_array(tensor) for name, tensor in zip(names, gradients, strict=True)},
            **(_pinhole(camera) if camera.pinhole else native_rays(camera, normals.dtype)),
            scale=weight / (camera.H * camera.W),
            jump=JUMP,
            threads=native_threads(),
        )
        ctx.save_for_backward(*gradients)
        return normals.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        return (*(chained(gradient, grad) for gradient in ctx.saved_tensors), None, None)


def _pinhole(camera: Camera) -> dict[str, Any]:
    """Return the arguments of a pinhole for the native call."""
    intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return {"R": camera.R.ravel().tolist(), **intrinsics}

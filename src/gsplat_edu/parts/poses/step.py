"""A step of one camera's pose, or of its motion during the readout, towards its photo: from a render and its depth.

A turn by w about the camera's own axes and a shift of the camera by t move what a pixel shows, at depth z, by

    x_cam' = x_cam + w x x_cam - R t,    δp = J_π (w x x_cam - R t)

(J_π: Jacobian of the camera's projection.) A change of the motion of a rolling shutter does so in proportion to the
time of the pixel, tau - 1/2.

and change the render I by -∇I·δp. The step is the Gauss-Newton step of

    Σ_pixels ω |I - P - ∇I·δp + g (I + 0.055)|² / (K σ²)  +  |(w, t / extent) + d|² / s²

for the photo P. A photo may be brighter than the scene, so the render first gets the median gain of each channel; what
is left of it, g, is solved for too and dropped. σ is the spread of
the residuals, ω gives less weight to large ones. An unfinished scene is wrong over whole regions, so K pixels count as
one observation. d is the camera's present deviation from its given pose, and s the standard deviation of given poses,
which keeps the given pose if the photo determines little.

Unlike Adam, whose steps are as large as its rate even where the pose is right, this step is as large as the error.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from gsplat_edu.base.constants import SRGB_OFFSET
from gsplat_edu.base.threads import one_thread
from gsplat_edu.base.validation import check_shape
from gsplat_edu.scene.camera import Camera

SAMPLES = 1 << 12
"""Approximate number of grid pixels at which a step is measured."""

FEWEST = 64
"""Keep the pose if fewer pixels count."""

PIXELS_PER_OBSERVATION = 1000.0
"""K. With 50 the poses of a clean capture drift by 0.3 instead of 0.1 degrees (docs/RECIPE.md)."""

LEAST_SIGMA = 1e-3
"""Lower bound of sigma: a quarter of an 8-bit level."""

GAIN_PRIOR = 1e-6
"""Weight of the prior that pulls g to 0, so that black photos have a solution."""


@torch.no_grad()
def pose_step(
    image: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    camera: Camera,
    photo: UInt8[Tensor, "H W 3"] | Float[Tensor, "H W 3"],
    moved: Float64[Tensor, "6"],
    spread: Float64[Tensor, "6"],
    mask: Bool[Tensor, "H W"] | None = None,
    times: Float64[np.ndarray, "H W"] | None = None,
) -> Float64[Tensor, "6"]:
    """Return the twist that brings a camera closer to its photo (`CameraTensors.moved`), or the change of its motion.

    Args:
        image: (H, W, 3) render of the camera.
        depth: (H, W) its median depth, world units; 0 where it shows nothing solid.
        camera: The camera, of the render's size.
        photo: (H, W, 3) uint8, or float from 0 to 1.
        moved: (6,) how far the camera is from its given pose, radians and world units.
        spread: (6,) standard deviation of the given pose from the true one, radians and world units.
        mask: (H, W) true for pixels that count; None if all do.
        times: (H, W) tau - 1/2 of every pixel, for the change of turn and shift of a rolling shutter; None for a twist.

    Returns:
        (6,) w, radians, and t, world units, on the CPU; 0 if too few pixels count. The same bits for any number of
        threads.

    Raises:
        ShapeError: the sizes differ.
    """
    check_shape("image", image.shape, (camera.H, camera.W, 3), {})
    check_shape("photo", photo.shape, image.shape, {})
    check_shape("depth", depth.shape, image.shape[:2], {})
    with one_thread():
        found = _samples(image, depth, photo, mask)
        if found is None:
            return torch.zeros(6, dtype=torch.float64)
        pixels, z, light, slopes, residual = found
        sigma = 1.4826 * residual.abs().flatten().median() + LEAST_SIGMA
        weights = (
            1.0 / (1.0 + (residual / (2.0 * sigma)).square()) / (PIXELS_PER_OBSERVATION * sigma.square())
        )
        flow = image_flow(camera, pixels, z) if camera.projection.plain else lens_flow(camera, pixels, z)
        if times is not None:
            columns, rows = pixels.long().unbind(dim=1)
            flow = flow * torch.from_numpy(np.array(times))[rows, columns][:, None, None]
        flow = -(flow * spread)
        normal, slope = _normal_equations(flow, slopes, light, residual, weights)
        normal += torch.diag(torch.tensor([1.0] * 6 + [GAIN_PRIOR] * 3, dtype=torch.float64))
        slope[:6] += moved / spread
        step: Float64[Tensor, "6"] = -torch.linalg.solve(normal, slope)[:6] * spread
        return step


def _normal_equations(
    flow: Float64[Tensor, "n 2 6"],
    slopes: Float64[Tensor, "n 3 2"],
    light: Float64[Tensor, "n 3"],
    residual: Float64[Tensor, "n 3"],
    weights: Float64[Tensor, "n 3"],
) -> tuple[Float64[Tensor, "9 9"], Float64[Tensor, "9"]]:
    """Return the matrix and the right side for six numbers of a twist, by which a pixel flows, and three gains.

    The channels are summed for each pixel first, which leaves a symmetric 2 x 2 matrix for the flow.
    """
    moves, heavy = flow.reshape(-1, 6), weights[..., None] * slopes
    (a, b), (c, d) = ((heavy[..., i, None] * slopes).sum(dim=1).unbind(dim=1) for i in (0, 1))
    right, down = flow[:, 0], flow[:, 1]
    pulled = torch.stack(
        [a[:, None] * right + b[:, None] * down, c[:, None] * right + d[:, None] * down], dim=1
    )
    normal = residual.new_zeros(9, 9)
    normal[:6, :6] = moves.T @ pulled.reshape(-1, 6)
    normal[:6, 6:] = moves.T @ (heavy * light[..., None]).transpose(1, 2).reshape(-1, 3)
    normal[6:, :6] = normal[:6, 6:].T
    normal[6:, 6:] = torch.diag((weights * light.square()).sum(dim=0))
    along = (heavy * residual[..., None]).sum(dim=1).reshape(-1)
    return normal, torch.cat([moves.T @ along, (weights * light * residual).sum(dim=0)])


def _samples(
    image: Tensor, depth: Tensor, photo: Tensor, mask: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None:
    """Return the pixels of a grid that count, float64 on the CPU; None if they are fewer than `FEWEST`.

    Returns:
        (n, 2) columns and rows, (n,) depths, (n, 3) colours of the render + 0.055 at the exposure of the photo,
        (n, 3, 2) their slopes per pixel to the right and down, (n, 3) render minus photo.
    """
    H, W = depth.shape
    step = max(1, math.isqrt(H * W // SAMPLES))

    def taken(plane: Tensor, down: int = 0, right: int = 0) -> Tensor:
        rows, columns = slice(1 + down, H - 1 + down, step), slice(1 + right, W - 1 + right, step)
        part = plane[rows, columns].detach().cpu()
        return part.reshape(-1, *part.shape[2:]).double()

    colors, truth, z = taken(image), taken(photo), taken(depth)
    if photo.dtype == torch.uint8:
        truth = truth / 255.0
    slopes = [taken(image, 0, 1) - taken(image, 0, -1), taken(image, 1, 0) - taken(image, -1, 0)]
    rows, columns = torch.meshgrid(
        torch.arange(1, max(H - 1, 1), step), torch.arange(1, max(W - 1, 1), step), indexing="ij"
    )
    pixels = torch.stack([columns.reshape(-1), rows.reshape(-1)], dim=1).double()
    counts = (z > 0) & torch.isfinite(colors).all(dim=1)
    counts &= torch.isfinite(slopes[0] + slopes[1]).all(dim=1)
    if mask is not None:
        check_shape("mask", mask.shape, depth.shape, {})
        counts &= taken(mask) > 0
    if int(counts.sum()) < FEWEST:
        return None
    x, y, both = colors[counts] + SRGB_OFFSET, truth[counts] + SRGB_OFFSET, torch.stack(slopes, dim=2)[counts]
    gains = torch.stack(
        [ratios.contiguous().median() for ratios in (y / x.clamp_min(SRGB_OFFSET)).unbind(dim=1)]
    )
    return pixels[counts], z[counts], gains * x, gains[:, None] * both / 2.0, gains * x - y


def image_flow(
    camera: Camera, pixels: Float64[Tensor, "n 2"], z: Float64[Tensor, " n"]
) -> Float64[Tensor, "n 2 6"]:
    """Return the motion of the image per unit of each component of a twist, px to the right and down."""
    middle = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    x, y = ((pixels - middle) / focal).unbind(dim=1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    # of w: w x x_cam, with x_cam = z (x, y, 1)
    turn = torch.stack([-x * y, 1 + x * x, -y, -(1 + y * y), x * y, x], dim=1).reshape(-1, 2, 3)
    shift = -torch.stack([one, zero, -x, zero, one, -y], dim=1).reshape(-1, 2, 3) @ torch.from_numpy(
        camera.R.copy()
    )
    return torch.cat([turn, shift / z[:, None, None]], dim=2) * focal[:, None]


def lens_flow(
    camera: Camera, pixels: Float64[Tensor, "n 2"], depth: Float64[Tensor, " n"]
) -> Float64[Tensor, "n 2 6"]:
    """Return the same for any projection; 0 for pixels without a ray."""
    u, v = pixels.numpy().T
    a, b = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    rays = camera.projection.directions(a, b, camera.widest)
    points = rays * depth.numpy()[:, None]
    if camera.projection.kind == "orthographic":
        points[:, :2] = np.stack([a, b], axis=1)
    seen = np.isfinite(points).all(axis=1)
    points[~seen] = (0.0, 0.0, 1.0)
    own = Camera.posed(np.eye(3), np.zeros(3), camera.intrinsics).sight(points)
    J = np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in own.jacobian], axis=1)
    x, y, z = points.T
    zero = np.zeros_like(x)
    turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)  # w x p, by w
    flow = np.concatenate([J @ turn, -(J @ camera.R)], axis=2)
    return torch.from_numpy(np.where((seen & own.valid)[:, None, None], flow, 0.0))

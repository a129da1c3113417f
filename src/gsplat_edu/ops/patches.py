"""Patches of neighbouring photos: how well they agree when they are seen through a rendered surface.

Chapter: 15_cloud_to_surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from gsplat_edu.base.buffers import reusable_tensor
from gsplat_edu.base.derivatives import chained, first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import native_threads, one_thread
from gsplat_edu.base.validation import check_shape, whole_number
from gsplat_edu.ops.kernels import SUFFIXES, kernel, native_array
from gsplat_edu.ops.lenses import native_camera, native_rays, within_width
from gsplat_edu.ops.surface import check_maps
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.projection_formulas import POLE, Operations
from gsplat_edu.scene.sight import Optics, sight

RADIUS = 3
"""A patch has 7 x 7 pixels, as in Chen et al. 2024 (PGSR)."""

PIXELS = (2 * RADIUS + 1) ** 2
"""Pixels of a patch."""

MOST = 0.6
"""Largest loss of a patch, 1 - ncc: patches that agree less show another surface, as where one hides the other, and
learn nothing."""

LEAST_ALPHA = 0.9
"""A pixel has a surface if its alpha is at least this."""

LEAST_COSINE = 0.2
"""A patch is compared if |cos| of its rays and its normal is at least this, 78 degrees: nearer to edge-on, a pixel of
it covers five or more of the surface."""

LEAST_SPREAD = 2.0
"""Smallest standard deviation of a patch's values, in levels of 255: below it there is noise and no texture."""

JUDGED_SPREAD = 4.0
"""The same of a patch that is counted for or against a surface: noise of 1.5 levels then leaves an ncc above 0.8."""


@dataclass(frozen=True, eq=False)
class GreyPhoto:
    """A photo of one channel with its camera.

    Args:
        camera: The camera.
        pixels: (H, W) uint8 mean of red, green and blue, rounded.
        counts: (H, W) true for pixels that count; None if all do.

    Raises:
        ShapeError: the sizes differ from the camera's.
    """

    camera: Camera
    pixels: UInt8[np.ndarray, "H W"]
    counts: Bool[np.ndarray, "H W"] | None = None

    def __post_init__(self) -> None:
        """Check the sizes."""
        for name, plane in (("pixels", self.pixels), ("counts", self.counts)):
            if plane is not None:
                check_shape(name, plane.shape, (self.camera.H, self.camera.W), {})

    @classmethod
    def of(cls, photo: Photo, camera: Camera) -> GreyPhoto:
        """Return a photo without its colours; pixels count that its mask does not exclude and that are opaque."""
        image = photo.image if photo.image.dtype == np.uint8 else np.rint(255.0 * photo.image)
        total = image[..., 0].astype(np.uint16) + image[..., 1] + image[..., 2]
        counts, opaque = photo.mask, photo.opaque
        if opaque is not None:
            counts = opaque if counts is None else counts & opaque
        return cls(camera, ((total + 1) // 3).astype(np.uint8), counts)

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return self.pixels.nbytes + (0 if self.counts is None else self.counts.nbytes)


class Grid(NamedTuple):
    """Which pixels are the centres of patches: (first_u + k stride, first_v + l stride)."""

    stride: int
    first_u: int = 0
    first_v: int = 0

    def each(self, weight: float, H: int, W: int) -> float:
        """Return the factor of a patch if the mean over all pixels of the grid in an image has this weight."""
        count = len(range(self.first_v, H, self.stride)) * len(range(self.first_u, W, self.stride))
        return weight / max(count, 1)


class PatchLoss(NamedTuple):
    """How far patches are from their neighbours.

    Args:
        value: () scalar, differentiable in normals, depth and alpha.
        learning: Number of patches whose loss is below `MOST`.
    """

    value: Float[Tensor, ""]
    learning: int


class PatchCounts(NamedTuple):
    """How many patches of a photo agree with another photo.

    Args:
        seen: Patches with a surface that lie in both photos.
        textured: Those of them that vary by `JUDGED_SPREAD` or more in the photo.
        agreeing: Those of the textured ones whose loss is below `MOST`.
    """

    seen: int
    textured: int
    agreeing: int


def patch_error(
    normals: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    photo: GreyPhoto,
    other: GreyPhoto,
    grid: Grid,
    weight: float = 1.0,
) -> PatchLoss:
    """Return how far patches of a photo are from a neighbouring photo: weight mean min(1 - ncc, MOST).

    The plane of a patch goes through the mean depth of its centre, sum w z / a, with the composited normal. The plane
    leads every pixel of the patch to a point of the other photo; ncc is the correlation of the values there, by
    bilinear interpolation, with the patch's own: 1 if they differ by brightness and contrast only. The mean is over all
    pixels of the grid. Those add 0 that have no surface, see it edge-on, whose patch leaves a photo, has pixels that do
    not count or have no ray, or shows no texture. Each camera has its lens and shutter. The edges of a panorama meet
    behind it, so patches and interpolation go on across them; no patch is seen within a degree of its poles.

    Args:
        normals: (H, W, 3) composited `gsplat_edu.render.planes.facing_normals`.
        depth: (H, W) sum of w z, world units.
        alpha: (H, W) accumulated alpha.
        photo: The photo of this camera, which is not orthographic.
        other: The neighbouring photo.
        grid: The patches' centres.
        weight: Factor of the value.

    Raises:
        ShapeError: the sizes differ.
        ArgumentError: dtypes or devices differ, the grid is impossible, or the camera is orthographic.

    Source: Chen et al. 2024 (PGSR), eq. 13.
    """
    check_maps(normals, depth, alpha, photo.camera)
    whole_number("stride", grid.stride, 1)
    whole_number("first_u", grid.first_u, 0)
    whole_number("first_v", grid.first_v, 0)
    if photo.camera.projection.kind == "orthographic":
        raise ArgumentError("photo: is orthographic, but patches need rays that meet; give photos of a lens")
    if normals.device.type != "cpu" or normals.dtype not in SUFFIXES:
        return patch_error_in_torch(normals, depth, alpha, photo, other, grid, weight)
    learning: list[int] = []
    value: Tensor = _PatchError.apply(  # type: ignore[no-untyped-call]
        normals, depth, alpha, photo, other, (grid, weight), learning
    )
    return PatchLoss(value, learning[0])


def relative_pose(camera: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and shift (3,) from a camera's axes to another's: x -> rotation x + shift."""
    return other.R @ camera.R.T, other.R @ (camera.eye - other.eye)


@one_thread()  # the rounding of torch's sum depends on the number of threads
def patch_error_in_torch(
    normals: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    photo: GreyPhoto,
    other: GreyPhoto,
    grid: Grid,
    weight: float = 1.0,
) -> PatchLoss:
    """Return `patch_error` from its definition, by torch's operations, on any device."""
    H, W = alpha.shape
    products, squares, held = _products(normals, depth, alpha, photo, other, grid)
    held = held & (squares.detach() >= LEAST_SPREAD**2 * PIXELS).all(dim=0)
    lengths = squares.where(held, 1.0).sqrt()
    error = 1 - products / (lengths[0] * lengths[1])
    bounded = error.clamp(max=MOST).where(held, 0.0)
    value = grid.each(weight, H, W) * bounded.sum()
    return PatchLoss(value, int((held & (error < MOST)).sum()))


@one_thread()
def patch_counts(
    normals: Float[Tensor, "H W 3"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    photo: GreyPhoto,
    other: GreyPhoto,
    grid: Grid,
) -> PatchCounts:
    """Count the patches of `patch_error` that agree with the other photo, to judge a surface.

    A patch with texture in the photo and none in the other one does not agree.

    Args:
        normals: As for `patch_error`, like all others.
        depth: (H, W) sum of w z, world units.
        alpha: (H, W) accumulated alpha.
        photo: The photo of this camera, which is not orthographic.
        other: The other photo.
        grid: The patches' centres.
    """
    with torch.no_grad():
        products, squares, held = _products(normals, depth, alpha, photo, other, grid)
    textured = held & (squares[0] >= JUDGED_SPREAD**2 * PIXELS)
    agreeing = textured & (products > (1 - MOST) * (squares[0] * squares[1]).sqrt())
    return PatchCounts(int(held.sum()), int(textured.sum()), int(agreeing.sum()))


def _products(
    normals: Tensor, depth: Tensor, alpha: Tensor, photo: GreyPhoto, other: GreyPhoto, grid: Grid
) -> tuple[Tensor, Tensor, Tensor]:
    """Return of each patch, without its mean, its product with the other photo (P,) and both squares (2, P).

    The last tensor says which patches lie in both photos with all of their pixels (P,).
    """
    H, W = alpha.shape
    seats = [torch.arange(first, size, grid.stride) for first, size in ((grid.first_v, H), (grid.first_u, W))]
    v, u = (seat.reshape(-1).to(alpha.device) for seat in torch.meshgrid(*seats, indexing="ij"))
    away = torch.arange(-RADIUS, RADIUS + 1, device=alpha.device)
    down, right = (offsets.reshape(-1) for offsets in torch.meshgrid(away, away, indexing="ij"))
    wraps, other_wraps = photo.camera.projection.wraps, other.camera.projection.wraps
    held = (v >= RADIUS) & (v < H - RADIUS) & (W > 2 * RADIUS)
    if not wraps:
        held = held & (u >= RADIUS) & (u < W - RADIUS)
    held = held & (alpha[v, u] >= LEAST_ALPHA) & (normals[v, u] != 0).any(dim=-1) & (depth[v, u] > 0)
    u, v = u[held], v[held]
    of_u, of_v = (u[:, None] + right) % W, v[:, None] + down  # the modulus changes columns of a panorama only
    own, counts = _values(photo, normals, of_u, of_v)
    cameras = photo.camera, other.camera
    find = _seen if photo.camera.pinhole and other.camera.pinhole else _seen_through_lenses
    x, y, held = find(normals, depth, alpha, cameras, (u, v), (of_u, of_v))
    last_u, last_v = other.camera.W - 1, other.camera.H - 1
    if other_wraps:
        x = within_width(x, other.camera.W)
        last_u = other.camera.W
    held = held & ((x >= 0) & (y >= 0) & (x <= last_u) & (y <= last_v)).all(dim=1) & counts
    left, top = (at.detach().floor().clamp(0, max(last - 1, 0)) for at, last in ((x, last_u), (y, last_v)))
    corners, weights = [], ((1 - (x - left), x - left), (1 - (y - top), y - top))
    for below in (0, 1):
        for beside in (0, 1):
            at_u, at_v = (left + beside).clamp(max=last_u).long(), (top + below).clamp(max=last_v).long()
            at_u = at_u % other.camera.W
            values, counts = _values(other, normals, at_u, at_v)
            held = held & counts
            corners.append(values * weights[0][beside] * weights[1][below])
    seen = corners[0] + corners[1] + corners[2] + corners[3]
    own, seen = own - own.mean(dim=1, keepdim=True), seen - seen.mean(dim=1, keepdim=True)
    squares = torch.stack([(own * own).sum(dim=1), (seen * seen).sum(dim=1)])
    return (own * seen).sum(dim=1), squares, held


def _values(photo: GreyPhoto, like: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return the values at pixels (P, K), and whether all of a patch's count (P,)."""
    values = torch.from_numpy(np.array(photo.pixels)).to(like)[v, u]
    if photo.counts is None:
        return values, torch.ones(len(u), dtype=torch.bool, device=like.device)
    return values, torch.from_numpy(np.array(photo.counts)).to(like.device)[v, u].all(dim=1)


def _seen(
    normals: Tensor,
    depth: Tensor,
    alpha: Tensor,
    cameras: tuple[Camera, Camera],
    centre: tuple[Tensor, Tensor],
    pixels: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return where the other camera sees patches' pixels, (P, K) each, px, and whether it sees all of one (P,)."""
    camera, other = cameras
    to_camera, turn, shift = (
        torch.from_numpy(np.array(m)).to(normals) for m in (camera.R, *relative_pose(*cameras))
    )
    u, v = centre
    z = depth[v, u] / alpha[v, u]
    n = torch.nn.functional.normalize(normals[v, u], dim=-1) @ to_camera.T

    def ray(u: Tensor, v: Tensor) -> Tensor:
        x, y = (u.to(n) - camera.cx) / camera.fx, (v.to(n) - camera.cy) / camera.fy
        return torch.stack([x, y, torch.ones_like(x)], dim=-1)

    rays = ray(*pixels)
    facing, of_pixels = (n * ray(u, v)).sum(dim=-1), (n[:, None] * rays).sum(dim=-1)
    held = (of_pixels < -LEAST_COSINE * rays.norm(dim=-1)).all(dim=1)
    s = (z * facing)[:, None] / of_pixels.where(held[:, None], -1.0)
    points = (s[..., None] * rays) @ turn.T + shift
    held = held & (points[..., 2] > 0).all(dim=1)
    ahead = points[..., 2].where(held[:, None], 1.0)
    return other.fx * points[..., 0] / ahead + other.cx, other.fy * points[..., 1] / ahead + other.cy, held


def _seen_through_lenses(
    normals: Tensor,
    depth: Tensor,
    alpha: Tensor,
    cameras: tuple[Camera, Camera],
    centre: tuple[Tensor, Tensor],
    pixels: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the same as `_seen` for cameras with any lens and shutter, of which at least one is no pinhole."""
    camera, other = cameras
    found = camera.rays()
    rayless = ~np.isfinite(found).all(axis=-1, keepdims=True)
    all_rays = torch.from_numpy(np.where(rayless, 0.0, found)).to(normals)
    start = torch.from_numpy(camera.origins() - other.eye).to(normals)
    u, v = centre
    z = depth[v, u] / alpha[v, u]
    n = torch.nn.functional.normalize(normals[v, u], dim=-1)
    rays, origins = all_rays[pixels[1], pixels[0]], start[pixels[1], pixels[0]]
    place = start[v, u] + z[:, None] * all_rays[v, u]
    of_pixels = (n[:, None] * rays).sum(dim=-1)
    held = (of_pixels < -LEAST_COSINE * rays.norm(dim=-1)).all(dim=1)
    s = (n[:, None] * (place[:, None] - origins)).sum(dim=-1) / of_pixels.where(held[:, None], -1.0)
    held = held & (s > 0).all(dim=1)
    points = (origins + s[..., None] * rays)[held]
    x, y = torch.zeros_like(s), torch.zeros_like(s)
    if not len(points):
        return x, y, held
    optics = Optics(other.projection, other.coefficients, other.widest, other.motion, other.readout)
    lens, size = (other.fx, other.fy, other.cx, other.cy), (other.H, other.W)
    seen = sight(
        (points[..., 0], points[..., 1], points[..., 2]),
        other.R.tolist(),
        (0.0, 0.0, 0.0),
        lens,
        optics,
        size,
        0.0,
        _TORCH,
    )
    valid = seen.valid
    if other.projection.kind == "equirectangular":
        own = (points.detach() @ torch.from_numpy(np.array(other.R)).to(points).T).square()
        valid = valid & (own[..., 0] + own[..., 2] > POLE**2 * own.sum(dim=-1))
    x, y = x.index_put((held,), seen.u), y.index_put((held,), seen.v)
    return x, y, held.index_put((held.clone(),), valid.all(dim=1))


_TORCH = Operations(torch.sqrt, torch.atan2, torch.where, torch.maximum)


@first_derivative_only("patch_error", "patch_error_in_torch")
class _PatchError(torch.autograd.Function):
    """Compute value and gradients in one native call; backward only scales."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        normals: Tensor,
        depth: Tensor,
        alpha: Tensor,
        photo: GreyPhoto,
        other: GreyPhoto,
        placed: tuple[Grid, float],
        learning: list[int],
    ) -> Tensor:
        given = [tensor.detach().contiguous() for tensor in (normals, depth, alpha)]
        gradients = [reusable_tensor(tensor.shape, tensor) for tensor in given]
        names, (grid, weight) = ("normals", "depth", "alpha"), placed
        value, count = kernel("patches_f", normals.dtype)(
            **{name: native_array(tensor) for name, tensor in zip(names, given, strict=True)},
            **{f"grad_{name}": native_array(tensor) for name, tensor in zip(names, gradients, strict=True)},
            **_named("photo", photo),
            **_named("other", other),
            **_pair(photo.camera, other.camera, normals.dtype),
            radius=RADIUS,
            **grid._asdict(),
            scale=grid.each(weight, photo.camera.H, photo.camera.W),
            most=MOST,
            least_alpha=LEAST_ALPHA,
            least_cosine=LEAST_COSINE,
            least_spread=LEAST_SPREAD,
            threads=native_threads(),
        )
        learning.append(count)
        ctx.save_for_backward(*gradients)
        return normals.new_tensor(value)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        return (*(chained(gradient, grad) for gradient in ctx.saved_tensors), None, None, None, None)


def _named(name: str, photo: GreyPhoto) -> dict[str, Any]:
    """Return the arguments of a photo for the native call."""
    camera, counts = photo.camera, photo.counts
    return {
        name: np.ascontiguousarray(photo.pixels),
        f"{name}_counts": None if counts is None else np.ascontiguousarray(counts).view(np.uint8),
        f"{name}_intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
    }


def _pair(camera: Camera, other: Camera, dtype: torch.dtype) -> dict[str, Any]:
    """Return the arguments of both cameras for the native call."""
    if camera.pinhole and other.pinhole:
        turn, shift = relative_pose(camera, other)
        return {"R": camera.R.ravel().tolist(), "turn": turn.ravel().tolist(), "shift": shift.tolist()}
    same, endless = np.eye(3).ravel().tolist(), (-np.inf, np.inf)
    return {
        "R": same,
        "turn": same,
        "shift": (camera.eye - other.eye).tolist(),
        "other_camera": native_camera(other, (endless, endless), True),
        **native_rays(camera, dtype),
    }

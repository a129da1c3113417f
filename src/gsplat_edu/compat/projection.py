"""gsplat's projection: centres, depths, conics and radii of all Gaussians in all cameras.

    p = R x + t,   u = fx px/pz + cx,   Sigma2d = J R Sigma R' J' + eps2d I,   compensation = sqrt(det0 / det)

These are the formulas of the pinhole, which `native/screen.cpp` has; other lenses and rolling shutters are here, in
torch, with `gsplat_edu.compat.lenses`. R and t come from the viewmat as any matrix, so that its gradient has all
entries. det0, the determinant before eps2d, is the squared length of a cross product where quaternions and scales are
known: a c - b² would cancel for thin Gaussians.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from gsplat_edu.base.constants import DET_FLOOR, THINNEST
from gsplat_edu.base.validation import flag
from gsplat_edu.compat.checks import (
    check_cameras,
    check_limits,
    check_projection_options,
    check_scene,
    check_size,
    expect,
)
from gsplat_edu.compat.lenses import KINDS_BY_MODEL, CameraModel, see
from gsplat_edu.compat.screen import Lens, OnScreen, Solids, box_radii, through_pinhole
from gsplat_edu.scene.gaussians import check_lengths, unchecked_rotations

MARGIN = 0.15
"""gsplat clamps x/z and y/z inside the Jacobian at the edge of the image, moved outwards by this fraction of its size.
It is our `RenderSettings(jacobian_limit=1.3)`."""

EXTENT = 3.33
"""Largest half extent of a Gaussian, standard deviations. Alpha reaches 1/255 at 3.329 of them if the opacity is 1."""

TRIANGLE = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Rows and columns of a covariance's upper triangle, in the order of six numbers."""


PLAIN_MODEL = CameraModel()
"""gsplat's pinhole."""


class Projected(NamedTuple):
    """N Gaussians of B batches in C cameras each. Where a radius is 0, the other entries mean nothing."""

    radii: Int32[Tensor, "B C N 2"]
    means2d: Float[Tensor, "B C N 2"]
    depths: Float[Tensor, "B C N"]
    conics: Float[Tensor, "B C N 3"]
    compensations: Float[Tensor, "B C N"]
    spreads: Float[Tensor, "B C N 3"]
    """xx, xy and yy of the covariance before eps2d, px², always float64."""


def solids_of(means: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None) -> Solids:
    """Join the leading axes to one.

    Args:
        means: (..., N, 3) centres, world units.
        covars: (..., N, 6) upper triangles, used instead of quaternions and scales if not None.
        quats: (..., N, 4) quaternions (w, x, y, z) of any length.
        scales: (..., N, 3) standard deviations, world units.
    """
    shape = (math.prod(means.shape[:-2]), means.shape[-2])
    if covars is not None:
        return Solids(means.reshape(*shape, 3), covars.reshape(*shape, 6))
    assert quats is not None
    assert scales is not None
    check_lengths(quats)
    return Solids(means.reshape(*shape, 3), None, quats.reshape(*shape, 4), scales.reshape(*shape, 3))


def project(
    solids: Solids,
    viewmats: Float[Tensor, "B C 4 4"],
    Ks: Float[Tensor, "B C 3 3"],
    lens: Lens,
    opacities: Float[Tensor, "B N"] | None,
    compensated: bool,
    model: CameraModel = PLAIN_MODEL,
) -> Projected:
    """Project every Gaussian into every camera of its batch.

    Args:
        solids: The Gaussians.
        viewmats: World to camera.
        Ks: Intrinsics, px.
        lens: Size of the image and limits.
        opacities: Make the radii tighter; None for radii that suit every opacity.
        compensated: Whether the compensations will multiply the opacities, for the radii.
        model: Lens and shutter; z at half time decides what is near and far.

    Everything is computed in float64 and returned in the dtype of the means. Only the spreads stay float64, because the
    determinants of thin Gaussians would lose their digits in float32.

    Differentiable in: solids, viewmats, Ks, model.
    """
    dtype, (viewmats, Ks) = solids.means.dtype, (viewmats.double(), Ks.double())
    if model.plain:
        found = through_pinhole(solids, viewmats, Ks, lens, MARGIN)
    else:
        found = _through_lens(solids, viewmats, Ks, lens, model)
    given = None if opacities is None else opacities[:, None].expand(found.depths.shape)
    radii = box_radii(found, given, compensated, lens, EXTENT)
    outputs = (found.centres, found.depths, found.conics, found.compensations)
    return Projected(radii, *(each.to(dtype) for each in outputs), found.spreads)


def _through_lens(
    solids: Solids,
    viewmats: Float[Tensor, "B C 4 4"],
    Ks: Float[Tensor, "B C 3 3"],
    lens: Lens,
    model: CameraModel,
) -> OnScreen:
    """Project through a lens or a rolling shutter, as `through_pinhole` does through a pinhole."""
    solids = Solids(*(None if each is None else each.double() for each in solids))
    R, t = viewmats[..., :3, :3], viewmats[..., None, :3, 3]
    depths = (solids.means[:, None] @ R.mT + t)[..., 2]
    before = (depths >= lens.near) & (depths <= lens.far)
    centre, jacobian, before = see(solids.means, viewmats, Ks, (lens.width, lens.height), model, before)
    a, b, c, det0 = _screen_covariances(solids, *(jacobian[..., k, :] for k in (0, 1)))
    wide, high = a + lens.eps2d, c + lens.eps2d
    det = det0 + lens.eps2d * (a + c) + lens.eps2d**2
    thick = det > THINNEST * (wide + high)  # others are not drawn
    floor = torch.where(thick, det, 1.0)
    return OnScreen(
        centre,
        depths,
        torch.stack([high / floor, -b / floor, wide / floor], dim=-1),
        torch.sqrt(det0.clamp(min=DET_FLOOR) / floor),
        torch.stack([a, b, c], dim=-1),
        before & thick,
    )


def _screen_covariances(
    solids: Solids, row0: Float[Tensor, "B C N 3"], row1: Float[Tensor, "B C N 3"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return xx, xy, yy and the determinant of J R Sigma R' J', given the two rows of J R."""
    if solids.covars is not None:
        xx, xy, xz, yy, yz, zz = solids.covars[:, None].unbind(-1)
        Sigma = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1)
        Sigma = Sigma.view(*Sigma.shape[:-1], 3, 3)
        side0, side1 = (torch.einsum("bxnij,bcnj->bcni", Sigma, row) for row in (row0, row1))
        a, b, c = (row0 * side0).sum(-1), (row0 * side1).sum(-1), (row1 * side1).sum(-1)
        return a, b, c, a * c - b * b
    assert solids.quats is not None
    assert solids.scales is not None
    s0, s1, s2 = solids.scales[:, None].unbind(-1)
    rotations = unchecked_rotations(solids.quats.reshape(-1, 4)).view(*solids.scales.shape, 3)
    turned = [torch.einsum("bcni,bnij->bcnj", row, rotations) for row in (row0, row1)]
    normal = torch.linalg.cross(*turned) * torch.stack([s1 * s2, s2 * s0, s0 * s1], dim=-1)
    side0, side1 = (row * solids.scales[:, None] for row in turned)
    products = (side0 * side0, side0 * side1, side1 * side1, normal * normal)
    a, b, c, det0 = (product.sum(dim=-1) for product in products)
    return a, b, c, det0


def fully_fused_projection(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    opacities: Tensor | None = None,
) -> tuple[Tensor | None, ...]:
    """Project Gaussians as gsplat 1.5.3's function of this name does; docs/GSPLAT.md lists the arguments.

    Returns:
        radii (int32), means2d, depths, conics and compensations, of shape (..., C, N, ...); packed: batch_ids,
        camera_ids and gaussian_ids, then the same of the Gaussians with positive radii only. Compensations are None
        unless asked for.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or not supported.

    Differentiable in: means, covars, quats, scales, viewmats, Ks.
    """
    check_projection_options(sparse_grad, camera_model)
    check_size(width, height)
    for name, value in (("packed", packed), ("calc_compensations", calc_compensations)):
        flag(name, value)
    check_limits(near_plane, far_plane, radius_clip, eps2d)
    batch, N = check_scene(
        {"means": means, "quats": quats, "scales": scales, "opacities": opacities}, covars is not None
    )
    if covars is not None:
        expect("covars", covars, (*batch, N, 6), means)
    C = check_cameras(viewmats, Ks, batch, means)
    lens = Lens(width, height, eps2d, near_plane, far_plane, radius_clip)
    flat = None if opacities is None else opacities.reshape(math.prod(batch), N)
    model = CameraModel(KINDS_BY_MODEL[camera_model])
    views = (viewmats.reshape(-1, C, 4, 4), Ks.reshape(-1, C, 3, 3))
    found = project(solids_of(means, covars, quats, scales), *views, lens, flat, calc_compensations, model)
    results = [*found[:4], found.compensations if calc_compensations else None]
    if not packed:
        return tuple(None if each is None else each.view(*batch, C, N, *each.shape[3:]) for each in results)
    drawn = (found.radii > 0).all(dim=-1)
    return (*drawn.nonzero().unbind(-1), *(None if each is None else each[drawn] for each in results))

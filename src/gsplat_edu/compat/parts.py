"""gsplat's single steps: covariances, cameras, the pinhole, and the relocation of its `MCMCStrategy`.

All compute in float64 and return the dtype of their first argument.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import first_index, flag, in_range
from gsplat_edu.compat.checks import check_camera_model, check_size, expect, real_tensor
from gsplat_edu.compat.projection import MARGIN, TRIANGLE
from gsplat_edu.render.torch.sight import TORCH
from gsplat_edu.scene.gaussians import check_tensor, quat_to_R_t
from gsplat_edu.scene.projection_formulas import OnPlane, fisheye, orthographic

OPACITY_LIMIT = 1.0 - 2.0**-23
"""Largest opacity that `compute_relocation` returns."""


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Build covariances (R S)(R S)' and their inverses from quaternions and scales.

    Args:
        quats: (..., 4) quaternions (w, x, y, z) of any length but 0.
        scales: (..., 3) standard deviations, not 0 where inverses are wanted.
        compute_covar: Whether to return covariances.
        compute_preci: Whether to return inverses.
        triu: Whether to return upper triangles, (..., 6), instead of (..., 3, 3).

    Returns:
        Covariances and inverses; None for each that was not requested.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite, a quaternion has zero length, or a scale is 0 where inverses are wanted.

    Differentiable in: quats, scales.
    """
    real_tensor("quats", quats)
    batch = tuple(quats.shape[:-1])
    expect("quats", quats, (*batch, 4), quats)
    expect("scales", scales, (*batch, 3), quats, "quats")
    named = {"compute_covar": compute_covar, "compute_preci": compute_preci, "triu": triu}
    wanted = {name: flag(name, value) for name, value in named.items()}
    if wanted["compute_preci"] and bool((none := scales.detach() == 0).any()):
        raise ArgumentError(
            f"scales{first_index(none.numpy())}: is 0, which has no inverse; pass compute_preci=False"
        )
    R = quat_to_R_t(quats.reshape(-1, 4).double()).view(*batch, 3, 3)

    def product(factors: Tensor) -> Tensor:
        M = R * factors[..., None, :]
        found = (M @ M.mT).to(quats.dtype)
        return found[..., TRIANGLE[0], TRIANGLE[1]] if wanted["triu"] else found

    return (
        product(scales.double()) if wanted["compute_covar"] else None,
        product(1.0 / scales.double()) if wanted["compute_preci"] else None,
    )


def world_to_cam(means: Tensor, covars: Tensor, viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Transform Gaussians to the axes of cameras: R x + t and R Sigma R'.

    Args:
        means: (..., N, 3) centres, world units.
        covars: (..., N, 3, 3) covariances, world units².
        viewmats: (..., C, 4, 4) world to camera.

    Returns:
        (..., C, N, 3) centres and (..., C, N, 3, 3) covariances.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite.

    Differentiable in: means, covars, viewmats.
    """
    real_tensor("means", means)
    real_tensor("viewmats", viewmats)
    batch, N = tuple(means.shape[:-2]), means.shape[-2] if means.ndim > 1 else 0
    expect("means", means, (*batch, N, 3), means)
    expect("covars", covars, (*batch, N, 3, 3), means)
    C = viewmats.shape[-3] if viewmats.ndim > 2 else 1
    expect("viewmats", viewmats, (*batch, C, 4, 4), means)
    R, t = viewmats.double()[..., :3, :3], viewmats.double()[..., None, :3, 3]
    moved = means.double()[..., None, :, :] @ R.mT + t
    turned = R[..., None, :, :] @ covars.double()[..., None, :, :, :] @ R.mT[..., None, :, :]
    return moved.to(means.dtype), turned.to(means.dtype)


def proj(
    means: Tensor, covars: Tensor, Ks: Tensor, width: int, height: int, camera_model: str = "pinhole"
) -> tuple[Tensor, Tensor]:
    """Project Gaussians in camera axes: centres and J Sigma J'. A pinhole's J has clamped x/z and y/z, as gsplat's.

    Args:
        means: (..., C, N, 3) centres in camera axes.
        covars: (..., C, N, 3, 3) covariances in camera axes.
        Ks: (..., C, 3, 3) intrinsics, px; skew is not read.
        width: Width of the images, px.
        height: Height of the images, px.
        camera_model: "pinhole", "ortho" or "fisheye".

    Returns:
        (..., C, N, 2) centres, px, and (..., C, N, 2, 2) covariances, px², before eps2d.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or not supported.

    Differentiable in: means, covars, Ks.
    """
    real_tensor("means", means)
    check_camera_model(camera_model)
    check_size(width, height)
    batch = tuple(means.shape[:-2])
    N = means.shape[-2] if means.ndim > 2 else 0
    expect("means", means, (*batch[:-1], *batch[-1:], N, 3), means)
    expect("covars", covars, (*batch, N, 3, 3), means)
    expect("Ks", Ks, (*batch, 3, 3), means)
    points, K = means.double(), Ks.double()
    x, y, z = points.unbind(-1)
    focals, middles = [K[..., k, k, None] for k in (0, 1)], [K[..., k, 2, None] for k in (0, 1)]
    if camera_model == "pinhole":
        a, b, *slopes = _clamped_perspective((x, y, z), focals, middles, (width, height))
    else:
        a, b, *slopes = fisheye(x, y, z, TORCH) if camera_model == "fisheye" else orthographic(x, y, z)
    rows = [
        focal[..., None] * torch.stack(slope, dim=-1) for focal, slope in zip(focals, slopes, strict=True)
    ]
    centre = [focal * at + middle for focal, at, middle in zip(focals, (a, b), middles, strict=True)]
    J = torch.stack(rows, dim=-2)
    return torch.stack(centre, dim=-1).to(means.dtype), (J @ covars.double() @ J.mT).to(means.dtype)


def _clamped_perspective(
    point: tuple[Tensor, Tensor, Tensor], focals: list[Tensor], middles: list[Tensor], size: tuple[int, int]
) -> OnPlane:
    """Return x/z and y/z, and their derivatives at the clamped ratios."""
    x, y, z = point
    zero, clamped = torch.zeros_like(z), []
    for ratio, focal, middle, side in zip((x / z, y / z), focals, middles, size, strict=True):
        low, high = -MARGIN * side - middle, (1 + MARGIN) * side - middle
        clamped.append(torch.minimum(torch.maximum(ratio, low / focal), high / focal))
    return OnPlane(x / z, y / z, (1 / z, zero, -clamped[0] / z), (zero, 1 / z, -clamped[1] / z))


@torch.no_grad()
def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, min_opacity: float = 0.005
) -> tuple[Tensor, Tensor]:
    """Return opacity and scales of each of n Gaussians that take the place of one without changing the image.

    o' = 1 - (1 - o)^(1/n),   s' = s o / sum_i=1..n sum_k=0..i-1 C(i-1, k) (-1)^k o'^(k+1) / sqrt(k + 1)

    o' is clamped to [min_opacity, 1 - 2^-23] before the scales are computed, as in gsplat 1.6.0.

    Args:
        opacities: (N,) or (N, 1) 0 to 1.
        scales: (N, 3) standard deviations.
        ratios: (N,) n, clamped to 1 and to the size of the table. Unlike gsplat's, this function does not change it.
        binoms: (n_max, n_max) binomial coefficients C(row, column), 0 above the diagonal.
        min_opacity: Smallest new opacity, 0 to 1. 0 is the formula of gsplat 1.5.3.

    Returns:
        New opacities, of the shape of `opacities`, and scales (N, 3), of the dtype of `opacities`.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: a value is not finite or an opacity is outside 0 to 1.

    Source: Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", eq. 9.
    """
    real_tensor("opacities", opacities)
    N = len(opacities) if opacities.ndim else 0
    expect("opacities", opacities, (N, 1) if opacities.ndim == 2 else (N,), opacities)
    expect("scales", scales, (N, 3), opacities, "opacities")
    in_range("min_opacity", min_opacity, 0.0, OPACITY_LIMIT)
    sizes = {"N": N}
    check_tensor("ratios", ratios, ("N",), sizes)
    check_tensor("binoms", binoms, ("n_max", "n_max"), sizes)
    if bool((outside := (opacities < 0) | (opacities > 1)).any()):
        raise ArgumentError(f"opacities{first_index(outside.numpy())}: is outside 0 to 1")
    n_max = sizes["n_max"]
    if not n_max:
        raise ArgumentError("binoms: is empty, but has to hold C(0, 0)")
    n = ratios.double().clamp(1, n_max).long()
    old = opacities.double().reshape(N)
    new = (1.0 - (1.0 - old) ** (1.0 / n.double())).clamp(min_opacity, OPACITY_LIMIT)
    # sums over i = 1..n of C(i-1, k): a row for each n
    counts = binoms.double().cumsum(dim=0)[n - 1]
    k = torch.arange(n_max, dtype=torch.float64)
    terms = counts * (1 - 2 * (k % 2)) / (k + 1).sqrt() * new[:, None] ** (k + 1)
    total = terms.sum(dim=1)
    factor = torch.where(
        total > 0, old / torch.where(total > 0, total, 1.0), 1.0
    )  # nothing to share: as it was
    return new.to(opacities.dtype).view_as(opacities), (factor[:, None] * scales.double()).to(opacities.dtype)

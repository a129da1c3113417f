"""gsplat's `spherical_harmonics`, of 1.5.3 and of 1.6.0: our polynomials, and degree 4."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, overload

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.compat.checks import MOST_DEGREE, check_scene, expect
from gsplat_edu.compat.screen import harmonic_colors
from gsplat_edu.compat.tiles import ids_outside, whole_numbers
from gsplat_edu.scene.gaussians import check_tensor
from gsplat_edu.scene.sh import basis_terms

C4 = (
    0.75 * math.sqrt(35.0 / math.pi),
    -0.75 * math.sqrt(35.0 / (2.0 * math.pi)),
    0.75 * math.sqrt(5.0 / math.pi),
    -0.75 * math.sqrt(5.0 / (2.0 * math.pi)),
    3.0 / 16.0 * math.sqrt(1.0 / math.pi),
)
"""Factors of the harmonics m = -4 to 0 of degree 4, with the sign (-1)^m; each makes the square of its polynomial
integrate to 1 over the sphere."""


@overload
def spherical_harmonics(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None
) -> Tensor: ...


@overload
def spherical_harmonics(
    degrees_to_use: int,
    means: Tensor,
    viewmats: Tensor,
    coeffs: Tensor,
    masks: Tensor | None = None,
    batch_ids: Tensor | None = None,
    camera_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
    viewmats_rs: Tensor | None = None,
) -> Tensor: ...


def spherical_harmonics(degrees_to_use: int, *tensors: Any, **named: Any) -> Tensor:  # noqa: D417
    """Evaluate spherical harmonics in directions of any length: sum_i b_i(d / |d|) c_i.

    There is no offset and no floor; `rasterization` adds 0.5 and clamps at 0. Both interfaces of gsplat are here:

        spherical_harmonics(degrees_to_use, dirs, coeffs, masks=None)
        spherical_harmonics(degrees_to_use, means, viewmats, coeffs, masks=None, batch_ids=None, camera_ids=None,
                            gaussian_ids=None, viewmats_rs=None)

    The first is that of 1.5.3. The second, of 1.6.0, takes the directions from the cameras' centres -R' t to the means.
    It is meant if `means` or `viewmats` is named, or if three tensors of floats are given.

    Args:
        degrees_to_use: Highest degree to use, 0 to 4.
        dirs: (..., 3) directions; their length does not matter.
        means: (..., N, 3) centres of the Gaussians.
        viewmats: (..., C, 4, 4) world to camera; R has to be a rotation.
        coeffs: Coefficients, K >= (degree + 1)²: with `dirs` (..., K, D) or one set for all leading axes, (N, K, D);
            with `means` (N, K, D), packed (nnz, K, D). float16 coefficients are computed with in the dtype of the rest.
        masks: Booleans, one for each row of the result; it is 0, without a gradient, where one is False.
        batch_ids: (nnz,) packed only: the scene,
        camera_ids: (nnz,) the camera,
        gaussian_ids: (nnz,) and the Gaussian of each row.
        viewmats_rs: (..., C, 4, 4) poses at the end of a rolling shutter; centres are the means of both.

    Returns:
        (..., D) values; with `means` (..., C, N, D), packed (nnz, D).

    Raises:
        ShapeError: a shape differs, or K is too small for the degree.
        ArgumentError: the degree is not 0 to 4, or an argument is not a tensor of finite numbers.

    Differentiable in: dirs, coeffs, means, viewmats, viewmats_rs.
    """
    degree = whole_number("degrees_to_use", degrees_to_use, 0, MOST_DEGREE)
    of_cameras = bool({"means", "viewmats"} & named.keys()) or (len(tensors) >= 2 and "coeffs" in named)
    if len(tensors) >= 3 and isinstance(tensors[2], Tensor):
        of_cameras = of_cameras or tensors[2].is_floating_point()
    return (_from_cameras if of_cameras else _along)(degree, *tensors, **named)


def _along(degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Evaluate harmonics in the given directions."""
    for name, tensor in (("dirs", dirs), ("coeffs", coeffs)):
        check_tensor(name, tensor, ("...",), {})
    batch, count = dirs.shape[:-1], (degree + 1) ** 2
    if dirs.shape[-1:] != (3,):
        raise ShapeError(f"dirs: has shape {tuple(dirs.shape)}, but has to end in 3")
    leads = (batch, batch[-1:])
    if coeffs.ndim < 2 or coeffs.shape[:-2] not in leads or coeffs.shape[-2] < count or not coeffs.shape[-1]:
        expected = (*batch, f"{count} or more", "any")
        raise ShapeError(f"coeffs: has shape {tuple(coeffs.shape)}, but has to be {expected}")
    if masks is not None:
        check_tensor("masks", masks, ("...",), {})
        if masks.dtype != torch.bool:
            raise ArgumentError(f"masks: is {masks.dtype}, but has to be torch.bool")
        if masks.shape != batch:
            raise ShapeError(f"masks: has shape {tuple(masks.shape)}, but has to be {tuple(batch)}")
    count, total = math.prod(coeffs.shape[:-2]), math.prod(batch)
    rows = torch.arange(total) % max(count, 1)
    ends = list(range(count, total + 1, count)) if total else [0]
    flat = evaluate(degree, dirs.reshape(-1, 3), coeffs.reshape(-1, *coeffs.shape[-2:]), (rows, ends))
    values = flat.view(*batch, coeffs.shape[-1])
    return values if masks is None else torch.where(masks[..., None], values, 0.0)


def _from_cameras(
    degree: int,
    means: Tensor,
    viewmats: Tensor,
    coeffs: Tensor,
    masks: Tensor | None = None,
    batch_ids: Tensor | None = None,
    camera_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
    viewmats_rs: Tensor | None = None,
) -> Tensor:
    """Evaluate harmonics in the directions from cameras to means."""
    batch, N = check_scene({"means": means}, True)
    check_tensor("viewmats", viewmats, ("...",), {})
    C = viewmats.shape[-3] if viewmats.ndim > 2 else 1
    eyes = torch.zeros(())
    poses = {"viewmats": viewmats} | ({} if viewmats_rs is None else {"viewmats_rs": viewmats_rs})
    for name, pose in poses.items():
        expect(name, pose, (*batch, C, 4, 4), means)
        eyes = eyes - (pose[..., :3, :3].mT @ pose[..., :3, 3:])[..., 0] / len(poses)
    check_tensor("coeffs", coeffs, ("N", "K", "D"), {})
    ids = {"batch_ids": batch_ids, "camera_ids": camera_ids, "gaussian_ids": gaussian_ids}
    if all(each is None for each in ids.values()):
        dirs = means[..., None, :, :] - eyes[..., None, :]
    else:
        counts = (math.prod(batch), C, N)
        scenes, cameras, rows = (
            _ids(*each, len(coeffs)) for each in zip(ids, ids.values(), counts, strict=True)
        )
        dirs = means.reshape(-1, 3).index_select(0, scenes * N + rows)
        dirs = dirs - eyes.reshape(-1, 3).index_select(0, scenes * C + cameras)
    check_tensor("coeffs", coeffs, (dirs.shape[-2], "K", "D"), {})
    return _along(degree, dirs, coeffs, masks)


def _ids(name: str, given: object, count: int, length: int) -> Tensor:
    """Check packed ids."""
    ids = whole_numbers(name, given)
    if tuple(ids.shape) != (length,):
        raise ShapeError(f"{name}: has shape {tuple(ids.shape)}, but has to be {(length,)}, as coeffs")
    if ids_outside(ids, count):
        raise ArgumentError(f"{name}: has to be from 0 to {count - 1}")
    return ids


def spherical_harmonics_l0(sh0: Tensor) -> Tensor:
    """Evaluate the harmonic of degree 0 of coefficients (N, 1, D): (N, D), float32 for those of float16.

    Raises:
        ShapeError: the shape differs.
        ArgumentError: it is not a tensor of finite numbers.

    Differentiable in: sh0.
    """
    check_tensor("sh0", sh0, ("N", 1, "D"), {})
    directions = torch.ones(len(sh0), 3, dtype=torch.promote_types(sh0.dtype, torch.float32))
    return evaluate(0, directions, sh0, (torch.arange(len(sh0)), [len(sh0)]))


def spherical_harmonics_l1_plus(
    degrees_to_use: int,
    means: Tensor,
    viewmats: Tensor,
    shN: Tensor,
    masks: Tensor | None = None,
    batch_ids: Tensor | None = None,
    camera_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
    viewmats_rs: Tensor | None = None,
) -> Tensor:
    """Evaluate harmonics without degree 0; `shN` are the other coefficients, (N, K - 1, D), packed (nnz, K - 1, D).

    The other arguments, the result and the errors are those of `spherical_harmonics` with `means` and `viewmats`.
    """
    degree = whole_number("degrees_to_use", degrees_to_use, 0, MOST_DEGREE)
    sizes: dict[str, int] = {}
    check_tensor("shN", shN, ("N", "K", "D"), sizes)
    if sizes["K"] < (least := (degree + 1) ** 2 - 1):
        raise ShapeError(f"shN: has shape {tuple(shN.shape)}, but has to have {least} or more coefficients")
    coeffs = torch.nn.functional.pad(shN, (0, 0, 1, 0))
    return _from_cameras(
        degree, means, viewmats, coeffs, masks, batch_ids, camera_ids, gaussian_ids, viewmats_rs
    )


def evaluate(
    degree: int,
    dirs: Float[Tensor, "M 3"],
    coeffs: Float[Tensor, "R K D"],
    rows: tuple[Int64[Tensor, " M"], Sequence[int]],
) -> Float[Tensor, "M D"]:
    """Evaluate harmonics of any number of channels without checks; see `spherical_harmonics`.

    Args:
        degree: Highest degree to use.
        dirs: Directions.
        coeffs: Coefficients; those of float16 are computed with in the dtype of the directions.
        rows: The row of the coefficients for each direction, and where the rows of each image end.
    """
    coeffs = coeffs.to(dirs.dtype) if coeffs.dtype == torch.float16 else coeffs
    if degree < MOST_DEGREE and coeffs.shape[-1] == 3 and coeffs.dtype == dirs.dtype:
        return harmonic_colors(degree, dirs, coeffs, *rows)
    unit = torch.nn.functional.normalize(dirs, dim=-1)
    first, *others = basis_terms(min(degree, 3), *unit.unbind(-1))
    others += _fourth_degree(*unit.unbind(-1)) if degree == MOST_DEGREE else []
    basis = torch.stack([torch.full_like(unit[..., 0], first), *others], dim=-1)
    used = coeffs[:, : (degree + 1) ** 2].index_select(0, rows[0])
    values: Tensor = (basis[..., None] * used).sum(dim=-2)
    return values


def _fourth_degree(x: Tensor, y: Tensor, z: Tensor) -> Iterator[Tensor]:
    """Yield the nine harmonics of degree 4, m = -4 to 4."""
    xx, yy, zz = x * x, y * y, z * z
    yield C4[0] * x * y * (xx - yy)
    yield C4[1] * y * z * (3 * xx - yy)
    yield C4[2] * x * y * (7 * zz - 1)
    yield C4[3] * y * z * (7 * zz - 3)
    yield C4[4] * (zz * (35 * zz - 30) + 3)
    yield C4[3] * x * z * (7 * zz - 3)
    yield C4[2] / 2 * (xx - yy) * (7 * zz - 1)
    yield C4[1] * x * z * (xx - 3 * yy)
    yield C4[0] / 4 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy))

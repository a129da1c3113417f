"""gsplat's `spherical_harmonics`: our polynomials, and degree 4."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.compat.checks import MOST_DEGREE
from gsplat_edu.compat.screen import harmonic_colors
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


def spherical_harmonics(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None
) -> Tensor:
    """Evaluate spherical harmonics in directions of any length: sum_i b_i(d / |d|) c_i.

    There is no offset and no floor; `rasterization` adds 0.5 and clamps at 0.

    Args:
        degrees_to_use: Highest degree to use, 0 to 4.
        dirs: (..., 3) directions; their length does not matter.
        coeffs: (..., K, 3) coefficients, K >= (degree + 1)².
        masks: (...) booleans; the result is 0, without a gradient, where one is False.

    Returns:
        (..., 3) values.

    Raises:
        ShapeError: a shape differs, or K is too small for the degree.
        ArgumentError: the degree is not 0 to 4, or an argument is not a tensor of finite numbers.

    Differentiable in: dirs, coeffs.
    """
    degree = whole_number("degrees_to_use", degrees_to_use, 0, MOST_DEGREE)
    count = (degree + 1) ** 2
    for name, tensor in (("dirs", dirs), ("coeffs", coeffs)):
        check_tensor(name, tensor, ("...",), {})
    batch = dirs.shape[:-1]
    if dirs.shape[-1:] != (3,):
        raise ShapeError(f"dirs: has shape {tuple(dirs.shape)}, but has to end in 3")
    if (*coeffs.shape[:-2], coeffs.shape[-1]) != (*batch, 3) or coeffs.shape[-2] < count:
        expected = (*batch, f"{count} or more", 3)
        raise ShapeError(f"coeffs: has shape {tuple(coeffs.shape)}, but has to be {expected}")
    if masks is not None:
        check_tensor("masks", masks, ("...",), {})
        if masks.dtype != torch.bool:
            raise ArgumentError(f"masks: is {masks.dtype}, but has to be torch.bool")
        if masks.shape != batch:
            raise ShapeError(f"masks: has shape {tuple(masks.shape)}, but has to be {tuple(batch)}")
    rows = torch.arange(math.prod(batch))
    flat = evaluate(degree, dirs.reshape(-1, 3), coeffs.reshape(-1, *coeffs.shape[-2:]), (rows, [len(rows)]))
    colors = flat.view(*batch, 3)
    return colors if masks is None else torch.where(masks[..., None], colors, 0.0)


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
        coeffs: Coefficients.
        rows: The row of the coefficients for each direction, and where the rows of each image end.
    """
    if degree < MOST_DEGREE and coeffs.shape[-1] == 3 and coeffs.dtype == dirs.dtype:
        return harmonic_colors(degree, dirs, coeffs, *rows)
    coeffs = coeffs.index_select(0, rows[0])
    unit = torch.nn.functional.normalize(dirs, dim=-1)
    first, *others = basis_terms(min(degree, 3), *unit.unbind(-1))
    others += _fourth_degree(*unit.unbind(-1)) if degree == MOST_DEGREE else []
    basis = torch.stack([torch.full_like(unit[..., 0], first), *others], dim=-1)
    values: Tensor = (basis[..., None] * coeffs[..., : (degree + 1) ** 2, :]).sum(dim=-2)
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

"""gsplat's `spherical_harmonics` over our polynomials."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_edu.errors import ShapeError
from gsplat_edu.sh import basis_terms, num_coefficients


def spherical_harmonics(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None
) -> Tensor:
    """Evaluate spherical harmonics in directions of any length: sum_i b_i(d / |d|) c_i.

    There is no offset and no floor; `rasterization` adds 0.5 and clamps at 0.

    Args:
        degrees_to_use: Highest degree to use, 0 to 3. gsplat also has degree 4.
        dirs: (..., 3) directions; their length does not matter.
        coeffs: (..., K, 3) coefficients, K >= (degree + 1)².
        masks: (...) booleans; the result is 0, without a gradient, where one is False.

    Returns:
        (..., 3) values.

    Raises:
        ShapeError: a shape differs, or K is too small for the degree.
        ArgumentError: the degree is not 0, 1, 2 or 3.

    Differentiable in: dirs, coeffs.
    """
    count = num_coefficients(degrees_to_use)
    batch = dirs.shape[:-1]
    if dirs.shape[-1:] != (3,):
        raise ShapeError(f"dirs: has shape {tuple(dirs.shape)}, but has to end in 3")
    if (*coeffs.shape[:-2], coeffs.shape[-1]) != (*batch, 3) or coeffs.shape[-2] < count:
        expected = (*batch, f"{count} or more", 3)
        raise ShapeError(f"coeffs: has shape {tuple(coeffs.shape)}, but has to be {expected}")
    if masks is not None and masks.shape != batch:
        raise ShapeError(f"masks: has shape {tuple(masks.shape)}, but has to be {tuple(batch)}")
    unit = torch.nn.functional.normalize(dirs, dim=-1)
    first, *others = basis_terms(degrees_to_use, *unit.unbind(-1))
    basis = torch.stack([torch.full_like(unit[..., 0], first), *others], dim=-1)
    colors: Tensor = (basis[..., None] * coeffs[..., :count, :]).sum(dim=-2)
    return colors if masks is None else torch.where(masks[..., None], colors, 0.0)

"""Spherical harmonics, degrees 0 to 3: colour that changes with the viewing direction.

The order and signs of the 16 harmonics are those of Kerbl et al.'s code, which every scene file in the
field follows: within a degree from m = -l to m = l, with the Condon-Shortley sign (-1)^m.

Chapter: 06_spherical_harmonics.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.constants import C0, C1, C2, C3, SH_MAX_DEGREE, SH_OFFSET
from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.validation import ArrayLike, first_index, float64_array, whole_number

UNIT_TOLERANCE = 1e-3
"""Largest deviation of a viewing direction's length from 1."""


def sh_basis(dirs: ArrayLike) -> Float64[np.ndarray, "*batch 16"]:
    """Evaluate the 16 real spherical harmonics of degrees 0 to 3.

    Args:
        dirs: (..., 3) unit vectors from the camera to the point.

    Returns:
        (..., 16) values b_i, orthonormal over the sphere.

    Raises:
        ShapeError: the last axis is not 3.
        ArgumentError: a direction is NaN, infinite, or not of unit length.
    """
    dirs = float64_array("dirs", dirs, ("...", 3))
    length = np.linalg.norm(dirs, axis=-1)
    off = np.abs(length - 1.0) > UNIT_TOLERANCE
    if np.any(off):
        raise ArgumentError(f"dirs{first_index(off)}: has length {length[off][0]:g}; divide by it first")
    x, y, z = np.moveaxis(dirs, -1, 0)
    return np.stack([np.broadcast_to(term, x.shape) for term in basis_terms(SH_MAX_DEGREE, x, y, z)], axis=-1)


def eval_sh(degree: int, sh: ArrayLike, dirs: ArrayLike) -> Float64[np.ndarray, "N 3"]:
    """Evaluate the colours of N Gaussians seen from given directions.

    colour = max(0, sum_i b_i(d) sh_i + 0.5)

    Args:
        degree: Highest degree to use, 0 to 3.
        sh: (N, K, 3) coefficients, K >= (degree + 1)²; coefficients of higher degrees are ignored.
        dirs: (N, 3) unit vectors from the camera to each Gaussian.

    Returns:
        (N, 3) colours, at least 0, without an upper bound.

    Raises:
        ShapeError: a shape differs, N differs, or K is too small for the degree.
        ArgumentError: the degree is not 0, 1, 2 or 3; a number is NaN or infinite; a direction is not a unit vector.

    Source: Kerbl et al. 2023, section 4 and its code.
    """
    count = num_coefficients(degree)
    sizes: dict[str, int] = {}
    sh = float64_array("sh", sh, ("N", "K", 3), sizes)
    if sizes["K"] < count:
        raise ShapeError(f"sh: degree {degree} needs {count} coefficients per channel, got shape {sh.shape}")
    basis = sh_basis(float64_array("dirs", dirs, ("N", 3), sizes))
    colors: Float64[np.ndarray, "N 3"] = np.einsum("nk,nkc->nc", basis[:, :count], sh[:, :count]) + SH_OFFSET
    floored: Float64[np.ndarray, "N 3"] = np.maximum(colors, 0.0)
    return floored


def num_coefficients(degree: int) -> int:
    """Return the number of harmonics up to a degree: (degree + 1)².

    Raises:
        ArgumentError: the degree is not 0, 1, 2 or 3.
    """
    return (whole_number("degree", degree, 0, SH_MAX_DEGREE) + 1) ** 2


def basis_terms(degree: int, x: Any, y: Any, z: Any) -> list[Any]:  # noqa: ANN401
    """Return the harmonics up to `degree` as polynomials in x, y and z.

    Only +, - and * are used, so that the same code works for NumPy arrays and torch tensors; the first term is the
    number C0. The values are spherical harmonics where x² + y² + z² = 1.
    """
    terms = [C0]
    if degree >= 1:
        terms += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        terms += [
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2.0 * zz - xx - yy),
            C2[3] * x * z,
            C2[4] * (xx - yy),
        ]
    if degree >= 3:
        terms += [
            C3[0] * y * (3.0 * xx - yy),
            C3[1] * x * y * z,
            C3[2] * y * (4.0 * zz - xx - yy),
            C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            C3[4] * x * (4.0 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3.0 * yy),
        ]
    return terms


def sh_rotation(degree: int, R: ArrayLike) -> Float64[np.ndarray, "K K"]:
    """Return the effect of a rotation on the coefficients of degrees 1 and up: one block per degree.

    sum_k b_k(d) (M c)_k = sum_k b_k(R' d) c_k  for every direction d: the colours rotate with the scene.

    A rotated harmonic is a combination of harmonics of its own degree. So each block follows exactly from a
    least-squares fit over more directions than unknowns.

    Args:
        degree: Highest degree, 0 to 3.
        R: (3, 3) rotation.

    Returns:
        (K, K) matrix, K = (degree + 1)² - 1.

    Raises:
        ShapeError: R is not of shape (3, 3).
        ArgumentError: the degree is not 0, 1, 2 or 3.
    """
    R = float64_array("R", R, (3, 3))
    count = num_coefficients(degree)
    dirs = np.random.default_rng(0).normal(size=(64, 3))  # any directions that span the harmonics; fixed seed
    dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
    still, turned = sh_basis(dirs), sh_basis(dirs @ R)
    matrix = np.zeros((count - 1, count - 1))
    for level in range(1, degree + 1):
        block = slice(level**2, (level + 1) ** 2)
        inner = slice(block.start - 1, block.stop - 1)
        matrix[inner, inner] = np.linalg.lstsq(still[:, block], turned[:, block], rcond=None)[0]
    return matrix

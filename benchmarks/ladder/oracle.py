"""The reference image for every rung, and the tolerance."""

from __future__ import annotations

import numpy as np

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN
from gsplat_edu.render.numpy_reference import Extent, Stop, render_gaussians
from ladder.splats import Splats

ROUNDING = 2.0**-24
"""Largest relative error of one float32 operation."""


def oracle(splats: Splats, extent: Extent = "exact", stop: Stop = "none") -> tuple[np.ndarray, np.ndarray]:
    """Draw the splats with the reference renderer, in float64: image (H, W, 3), transmittance (H, W)."""
    return render_gaussians(*splats.flat(), extent=extent, stop=stop)


def alpha_error(size: np.ndarray, wgsl: bool = False, more_per_term: float = 0) -> np.ndarray:
    """Return d, the bound on the relative error of alpha in `tolerance`, for exponents whose terms have this size S.

    A WGSL kernel may compute the exponent as s² + t² from rounded coefficients, and its exp2 may err by 3 + 2 |p| units
    in the last place: there d = e (26 S + 62), |p| being at most 8 above the floor.
    """
    per_term, once = (26, 62) if wgsl else (10, 24)
    return ROUNDING * ((per_term + more_per_term) * size + once)


def tolerance(
    splats: Splats, conics_again: bool = False, wgsl: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Bound how far a float32 kernel may be from `oracle`, per pixel, for image (H, W, 3) and transmittance (H, W).

    Let e = 2^-24, and let S = (A dx² + C dy²) / 2 + |B dx dy| be the size of the exponent's terms, which may cancel.
    An exponent with at most ten roundings per term is off by 10 e S; opacity (or its logarithm, at most 8), exp and
    their product add 24 e. So d = e (10 S + 24) bounds the relative error of alpha. It is set to 1 if alpha is so near
    the floor that rounding decides whether it counts. The relative error t of T = product of (1 - alpha) is the sum of
    alpha / (1 - alpha) (d + e) + e over the splats in front. Each splat adds an error of w (t + d + 3 e) to the image,
    and each addition one of e times the image. Another tenth covers second-order terms.

    Args:
        splats: The splats that are drawn.
        conics_again: The kernel was given covariances and inverts them in float32, where the determinant cancels.
        wgsl: The kernel is one of `ladder.gpu`.
    """
    y, x = np.mgrid[: splats.H, : splats.W]
    T, T_error = np.ones((2, splats.H, splats.W)) * [[[1.0]], [[0.0]]]
    image, image_error = np.zeros((2, splats.H, splats.W, 3))
    drawn = np.zeros((splats.H, splats.W), int)
    for i in range(splats.count):
        (u, v), (A, B, C) = splats.means2d[i].astype(float), splats.conics[i].astype(float)
        dx, dy = x - u, y - v
        square, cross = 0.5 * (A * dx * dx + C * dy * dy), B * dx * dy
        cancels = (A * C + B * B) / (A * C - B * B)
        alpha = np.minimum(ALPHA_MAX, splats.opacities[i] * np.exp(-square - cross))
        error = alpha_error(square + np.abs(cross), wgsl, 16 * cancels if conics_again else 0)
        error = np.where(np.abs(alpha - ALPHA_MIN) <= error * ALPHA_MIN, 1.0, error)
        alpha = np.where((alpha >= ALPHA_MIN) | (error == 1.0), alpha, 0.0)
        w = (T * alpha)[..., None] * np.abs(splats.colors[i])
        image, drawn = image + w, drawn + (alpha > 0)
        image_error += w * (T_error + error + 3 * ROUNDING)[..., None]
        T_error = T_error + np.where(alpha > 0, alpha / (1 - alpha) * (error + ROUNDING) + ROUNDING, 0.0)
        T = T * (1 - alpha)
    return 1.1 * (image_error + (drawn * ROUNDING)[..., None] * image), 1.1 * (T * T_error) + ROUNDING

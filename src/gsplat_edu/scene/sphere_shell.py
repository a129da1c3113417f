"""Procedural scenes: Gaussians from a formula, with exactly known ground truth.

Chapter: 05_sort_and_composite.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.validation import in_range, whole_number


def sphere_shell(
    n: int = 2500, s_t: float = 0.06, s_n: float = 0.01, opacity: float = 0.8, seed: int = 0
) -> tuple[
    Float64[np.ndarray, "n 3"],
    Float64[np.ndarray, "n 3 3"],
    Float64[np.ndarray, "n 3"],
    Float64[np.ndarray, " n"],
]:
    """Cover the unit sphere with flat disks, coloured by their positions.

    Sigma = B diag(s_t², s_t², s_n²) B',  B = (t1, t2, normal);  colour = (P + 1) / 2

    t1 is the normalised cross product of the normal with the coordinate axis along which the normal is smallest (so the
    two are never parallel), and t2 = normal × t1.

    Args:
        n: Number of disks.
        s_t: Standard deviation along the sphere, world units.
        s_n: Standard deviation across it, world units.
        opacity: Opacity of every disk, 0 to 1.
        seed: Seed of the positions.

    Returns:
        means: (n, 3) points P on the unit sphere, uniform by area.
        cov3ds: (n, 3, 3) covariances, world units squared.
        colors: (n, 3) in [0, 1].
        opacities: (n,).

    Raises:
        ArgumentError: n or the seed is not a whole number of at least 0, a deviation is negative, or the
            opacity is outside 0 to 1.
    """
    n, seed = whole_number("n", n, 0), whole_number("seed", seed, 0)
    s_t, s_n = in_range("s_t", s_t, 0.0), in_range("s_n", s_n, 0.0)
    opacity = in_range("opacity", opacity, 0.0, 1.0)
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(0.0, 2.0 * np.pi, n)
    polar = np.arccos(rng.uniform(-1.0, 1.0, n))
    means = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )

    smallest_axis = np.eye(3)[np.abs(means).argmin(axis=-1)]
    t1 = np.cross(means, smallest_axis)
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    B = np.stack([t1, np.cross(means, t1), means], axis=-1)
    cov3ds = B * np.array([s_t, s_t, s_n]) ** 2 @ np.swapaxes(B, -1, -2)
    return means, cov3ds, (means + 1.0) / 2.0, np.full(n, opacity)

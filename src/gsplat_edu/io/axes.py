"""Conversion between this package's axes and those of y-up formats: a half turn about x, then the scene's own frame.

(x, y, z) right, down, forward  <->  (x, -y, -z) right, up, back

A half turn only changes signs, so converting there and back preserves the bits. A scene whose up direction is another
one is turned, and moved to its origin, by the transform of its root node.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float64

from gsplat_edu.scene.camera import WORLD_UP
from gsplat_edu.scene.frame import Vector, rotation_between
from gsplat_edu.scene.gaussians import Gaussians

POSITION_SIGNS = (1.0, -1.0, -1.0)

QUAT_SIGNS = (1.0, 1.0, -1.0, -1.0)
"""Signs of (w, x, y, z): q' = i q i*, with i the half turn."""

SH_REST_SIGNS = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)
"""Signs of the coefficients of degrees 1 to 3: the sign of b_i(x, -y, -z) relative to b_i(x, y, z)."""


def half_turned(gaussians: Gaussians) -> Gaussians:
    """Rotate Gaussians by a half turn about x: means, rotations and SH coefficients.

    Applying it twice restores the original bits.

    Args:
        gaussians: N Gaussians, raw parameters.

    Returns:
        N Gaussians in the other axes.
    """

    def signs(values: tuple[float, ...]) -> torch.Tensor:
        return torch.tensor(values, dtype=gaussians.means.dtype, device=gaussians.means.device)

    rest = signs(SH_REST_SIGNS[: gaussians.sh_rest.shape[1]])
    return Gaussians(
        means=gaussians.means * signs(POSITION_SIGNS),
        quats=gaussians.quats * signs(QUAT_SIGNS),
        log_scales=gaussians.log_scales,
        sh0=gaussians.sh0,
        sh_rest=gaussians.sh_rest * rest[:, None],
        logit_opacities=gaussians.logit_opacities,
    )


def root_transform(
    up: Vector | None, origin: Vector
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Return the transform of the root node of a y-up file: x' = R x + t, with x the half-turned coordinates.

    R is the shortest rotation that takes the scene's up direction to y, and t = R (half-turned origin).

    Args:
        up: The scene's up direction, in this package's axes; None if unknown, which turns nothing.
        origin: Position of the coordinates' zero, in this package's axes.
    """
    signs = np.array(POSITION_SIGNS)
    turn = rotation_between(signs * (up or WORLD_UP), signs * WORLD_UP)
    return turn, turn @ (signs * origin) + 0.0  # no -0.0

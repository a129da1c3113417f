"""Where training starts."""

from __future__ import annotations

import math

import torch

from gsplat_edu.gaussians import Gaussians
from gsplat_edu.validation import whole_number

START_SCALE = 0.09
"""World units: standard deviation of every start Gaussian; a few hundred of them fill the unit ball."""

START_LOGIT_OPACITY = -2.2
"""Opacity 0.0998: light enough for the Gaussians behind to get a gradient."""

QUAT_JITTER = 0.01
"""Standard deviation of the start quaternions around the identity."""

SH0_JITTER = 0.2
"""Standard deviation of the start coefficients around 0, which is mid-grey."""


def random_ball(count: int, generator: torch.Generator, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Fill the unit ball with near-grey, nearly isotropic, faint Gaussians.

    The draws come in this order: directions, radii, quaternions, sh0.

    Args:
        count: Number of Gaussians.
        generator: Source of the draws; it is left where the last draw put it.
        dtype: Float type of the parameters.

    Returns:
        `count` Gaussians of SH degree 0.

    Raises:
        ArgumentError: the count is not a whole number of at least 0.
    """
    count = whole_number("count", count, 0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    directions = draw(count, 3)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    radii = torch.rand(count, 1, generator=generator, dtype=dtype) ** (1 / 3)  # uniform by volume
    return Gaussians(
        means=directions * radii,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype) + QUAT_JITTER * draw(count, 4),
        log_scales=torch.full((count, 3), math.log(START_SCALE), dtype=dtype),
        sh0=(SH0_JITTER * draw(count, 3))[:, None, :],
        sh_rest=torch.zeros(count, 0, 3, dtype=dtype),
        logit_opacities=torch.full((count,), START_LOGIT_OPACITY, dtype=dtype),
    )

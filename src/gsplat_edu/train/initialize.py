"""Where training starts."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree

from gsplat_edu.constants import C0, SH_OFFSET
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.density.base import DensityStrategy
from gsplat_edu.train.density.mcmc import MCMC
from gsplat_edu.validation import ArrayLike, float64_array, whole_number

START_SCALE = 0.09
"""World units: standard deviation of every start Gaussian; a few hundred of them fill the unit ball."""

START_LOGIT_OPACITY = -2.2
"""Opacity 0.0998: light enough for the Gaussians behind to get a gradient."""

QUAT_JITTER = 0.01
"""Standard deviation of the start quaternions around the identity."""

SH0_JITTER = 0.2
"""Standard deviation of the start coefficients around 0, which is mid-grey."""

NEIGHBOURS = 3
"""Start scales come from the distances to this many nearest points. (Kerbl et al. 2023's code)"""

SMALLEST_DISTANCE = 1e-7**0.5
"""World units: floor under the start scales, for points that coincide. (Kerbl et al. 2023's code)"""


def from_points(points: ArrayLike, colors: ArrayLike, config: TrainConfig) -> Gaussians:
    """Put a Gaussian on every point: a ball as wide as the gap to its neighbours, of the point's colour.

    scale = factor * sqrt(mean squared distance to the 3 nearest points),  sh0 = (colour - 0.5) / C0

    Args:
        points: (N, 3) positions, world units.
        colors: (N, 3) colours, 0 to 1.
        config: Start opacity, scale factor, SH degree, seed; and the cap: of more points a random part is taken.

    Returns:
        Gaussians of the configuration's SH degree, float32; min(N, cap) of them.

    Raises:
        ShapeError: a shape differs, or the two have different N.
        ArgumentError: there are no points, or a number is NaN or infinite.

    Source: Kerbl et al. 2023, section 5.1 and its code.
    """
    sizes: dict[str, int] = {}
    points = float64_array("points", points, ("N", 3), sizes)
    colors = float64_array("colors", colors, ("N", 3), sizes)
    if not len(points):
        raise ArgumentError("points: are none; give at least one to start from")
    if config.max_gaussians is not None and len(points) > config.max_gaussians:
        chosen = np.random.default_rng(config.seed).permutation(len(points))[: config.max_gaussians]
        points, colors = points[np.sort(chosen)], colors[np.sort(chosen)]
    count = len(points)
    scales = np.full(count, START_SCALE)
    if count > 1:
        distances, _ = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, count))
        scales = np.sqrt(np.square(distances[:, 1:]).mean(axis=1))
    opacity, factor = config.start
    scales = factor * np.maximum(scales, SMALLEST_DISTANCE)
    num_rest = (config.sh_degree + 1) ** 2 - 1
    return Gaussians(
        means=torch.tensor(points, dtype=torch.float32),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.tensor(np.log(scales), dtype=torch.float32)[:, None].repeat(1, 3),
        sh0=torch.tensor((colors - SH_OFFSET) / C0, dtype=torch.float32)[:, None],
        sh_rest=torch.zeros(count, num_rest, 3),
        logit_opacities=torch.full((count,), math.log(opacity / (1 - opacity))),
    )


def from_gaussians(gaussians: Gaussians, config: TrainConfig) -> tuple[Gaussians, list[str]]:
    """Make trained Gaussians the start of another run.

    Those with a NaN or infinite parameter or a zero quaternion are left out, since no gradient repairs them. Harmonics
    above the run's degree are cut off; missing ones are zero.

    Args:
        gaussians: Raw parameters, relative to the run's origin.
        config: SH degree, and the cap.

    Returns:
        Gaussians of the configuration's SH degree, float32; and sentences that say what was changed.

    Raises:
        ArgumentError: none is left, or more than the cap.
    """
    whole = gaussians.finite_rows() & (gaussians.quats.abs().amax(dim=1) > 0)
    notes = []
    if broken := len(gaussians) - int(whole.sum()):
        notes.append(
            f"{broken} of {len(gaussians)} Gaussians are NaN, infinite or without rotation: left out"
        )
    kept = gaussians.map(lambda tensor: tensor.detach()[whole].float().contiguous())
    if not len(kept):
        raise ArgumentError("holds no Gaussian to start from; give another scene")
    if config.max_gaussians is not None and len(kept) > config.max_gaussians:
        raise ArgumentError(
            f"holds {len(kept)} Gaussians, more than --max-gaussians {config.max_gaussians}; raise that, or thin it out"
            " with `gsplat-edu convert --min-opacity`"
        )
    wanted, stored = (config.sh_degree + 1) ** 2 - 1, kept.sh_rest.shape[1]
    if stored > wanted:
        notes.append(
            f"harmonics up to degree {kept.sh_degree} are stored; those above --sh-degree are cut off"
        )
    elif stored < wanted:
        notes.append(f"harmonics up to degree {kept.sh_degree} are stored; the others start at zero")
    rest = torch.zeros(len(kept), wanted, 3)
    rest[:, : min(stored, wanted)] = kept.sh_rest[:, :wanted]
    return Gaussians(**(kept.tensors() | {"sh_rest": rest})), notes


def make_strategy(config: TrainConfig, extent: float, gaussians: Gaussians) -> DensityStrategy | None:
    """Make the density strategy that a configuration names; None for none.

    Args:
        config: The configuration; its seed is that of the strategy's draws.
        extent: Size of the scene, world units.
        gaussians: What training starts from.

    Raises:
        ArgumentError: the strategy is mcmc and there is no cap.
    """
    generator = torch.Generator().manual_seed(config.seed)
    if config.strategy == "adc":
        return AdaptiveDensityControl(config, extent, generator, gaussians)
    return MCMC(config, generator) if config.strategy == "mcmc" else None


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

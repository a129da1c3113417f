"""Initial Gaussians and the density strategy of a training."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import cKDTree

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array, whole_number
from gsplat_edu.ops.noise import NoiseKernel, add_noise_natively
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.density.base import DensityStrategy
from gsplat_edu.train.density.fast import PlannedDensity
from gsplat_edu.train.density.mcmc import MCMC
from gsplat_edu.train.far import Shell
from gsplat_edu.train.part import PLUGGED_STRATEGIES

START_SCALE = 0.09
"""Standard deviation of every start Gaussian, world units; a few hundred of them fill the unit ball."""

START_LOGIT_OPACITY = -2.2
"""Opacity 0.0998: low enough for the Gaussians behind to get a gradient."""

QUAT_JITTER = 0.01
"""Standard deviation of the start quaternions around the identity."""

SH0_JITTER = 0.2
"""Standard deviation of the start coefficients around 0, which is mid-grey."""

NEIGHBOURS = 3
"""Number of nearest points whose distances determine a start scale. (Kerbl et al. 2023's code)"""

SMALLEST_DISTANCE = 1e-7**0.5
"""Lower bound of the start scales, world units, for coincident points. (Kerbl et al. 2023's code)"""


def from_points(points: ArrayLike, colors: ArrayLike, config: TrainConfig) -> Gaussians:
    """Place a Gaussian on every point: a ball as large as the distance to its neighbours, of the point's colour.

    scale = factor * sqrt(mean squared distance to the 3 nearest points),  sh0 = (colour - 0.5) / C0

    Args:
        points: (N, 3) positions, world units.
        colors: (N, 3) colours, 0 to 1.
        config: Start opacity, scale factor, SH degree, seed and cap; of more points than the cap, a random subset
            is used.

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
        raise ArgumentError("points: is empty; give at least one point to start from")
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
    """Start a run from trained Gaussians.

    Gaussians with a NaN or infinite parameter or a zero quaternion are dropped, since no gradient repairs them.
    Harmonics above the run's degree are dropped; missing ones are zero.

    Args:
        gaussians: Raw parameters, relative to the run's origin.
        config: SH degree and cap.

    Returns:
        Gaussians of the configuration's SH degree, float32; and sentences that describe the changes.

    Raises:
        ArgumentError: no Gaussian remains, or more than the cap.
    """
    whole = gaussians.finite_rows() & (gaussians.quats.abs().amax(dim=1) > 0)
    notes = []
    if broken := len(gaussians) - int(whole.sum()):
        notes.append(
            f"left out {broken} of {len(gaussians)} Gaussians that are NaN, infinite or have a zero quaternion"
        )
    kept = gaussians.map(lambda tensor: tensor.detach()[whole].float().contiguous())
    if not len(kept):
        raise ArgumentError("contains no Gaussian to start from; give another scene")
    if config.max_gaussians is not None and len(kept) > config.max_gaussians:
        raise ArgumentError(
            f"contains {len(kept)} Gaussians, more than max_gaussians = {config.max_gaussians}; raise that, or leave"
            " out faint Gaussians"
        )
    wanted, stored = (config.sh_degree + 1) ** 2 - 1, kept.sh_rest.shape[1]
    if stored > wanted:
        notes.append(f"contains harmonics up to degree {kept.sh_degree}; those above sh_degree are dropped")
    elif stored < wanted:
        notes.append(f"contains harmonics up to degree {kept.sh_degree}; the others start at zero")
    rest = torch.zeros(len(kept), wanted, 3)
    rest[:, : min(stored, wanted)] = kept.sh_rest[:, :wanted]
    return Gaussians(**(kept.tensors() | {"sh_rest": rest})), notes


def make_strategy(
    config: TrainConfig,
    extent: float,
    gaussians: Gaussians,
    shell: Shell | None = None,
    add_noise: NoiseKernel = add_noise_natively,
    generator: torch.Generator | None = None,
) -> DensityStrategy | None:
    """Make the density strategy of a configuration; None for the strategy "none".

    Args:
        config: The configuration; its seed also seeds the strategy.
        extent: Size of the scene, world units.
        gaussians: The start Gaussians.
        shell: Where far splats lie; None if there are none.
        add_noise: Moves the means for mcmc; see `Backend.add_noise`.
        generator: Source of the strategy's draws; one with the configuration's seed if None.

    Raises:
        ArgumentError: the strategy is mcmc or fast and there is no cap.
    """
    if generator is None:
        generator = torch.Generator().manual_seed(config.seed)
    if config.strategy == "adc":
        return AdaptiveDensityControl(config, extent, generator, gaussians, shell)
    if config.strategy == "fast":
        return PlannedDensity(config, gaussians, shell)
    if config.strategy == "mcmc":
        return MCMC(config, generator, shell, add_noise)
    if config.strategy in PLUGGED_STRATEGIES:
        settings = config.plugged[config.strategy]
        made: DensityStrategy = PLUGGED_STRATEGIES[config.strategy].make(
            settings, gaussians, extent, generator
        )
        return made
    return None


def random_ball(count: int, generator: torch.Generator, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Fill the unit ball with near-grey, nearly isotropic, faint Gaussians.

    The order of the draws is directions, radii, quaternions, sh0.

    Args:
        count: Number of Gaussians.
        generator: Source of the draws; its state advances.
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

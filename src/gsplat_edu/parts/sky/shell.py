"""The sky as splats: a shell far behind the scene, trained with it and stored like any other splats."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.parts.sky.find import CELLS, Sky, fibonacci
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.far import Shell

MOST = 3_000
"""Largest number of splats of the shell at the start."""

FINEST = math.radians(1.0)
"""Smallest distance of neighbouring splats at the start."""

SPLAT_WIDTH, FLATNESS = 0.65, 0.1
"""Standard deviation of a splat along the shell, in distances between neighbours; and across the shell, relative to the
one along it."""

OPACITY = 0.95

MARGIN = 3.0
"""A direction belongs to the sky if a sky pixel lies within this many px, or within half a splat's distance if that is
larger."""

VOTES = 64
"""A splat's colour is the median of this many nearest pixels."""


def sky_splats(sky: Sky, shell: Shell, sh_degree: int, most: int = MOST) -> Gaussians:
    """Place splats on a shell where photos show the sky.

    Args:
        sky: The sky, with at least one pixel.
        shell: The shell.
        sh_degree: SH degree of the splats.
        most: Largest number of splats, at least 1.

    Returns:
        Flat, nearly opaque Gaussians of the median colour of their pixels, float32.
    """
    pixels = cKDTree(sky.directions)
    count = round(4 * math.pi / FINEST**2)
    share = float(_in_sky(pixels, sky, fibonacci(CELLS)).mean())
    count = min(count, max(int(most / max(share, 1 / CELLS)), 1))
    grid = fibonacci(count)
    directions = grid[_in_sky(pixels, sky, grid)]
    while len(directions) > most:
        count -= max(count // 50, 1)
        grid = fibonacci(count)
        directions = grid[_in_sky(pixels, sky, grid)]
    if not len(directions):  # a sky smaller than a cell
        directions = sky.directions[:1]
    return _gaussians(sky, shell, directions, math.sqrt(4 * math.pi / count), sh_degree, pixels)


def _in_sky(pixels: cKDTree, sky: Sky, grid: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return which directions have a pixel of the sky near them."""
    reach = max(MARGIN * sky.pixel, math.sqrt(math.pi / len(grid)))
    return np.asarray(pixels.query(grid, distance_upper_bound=reach)[0] < np.inf)


def _gaussians(
    sky: Sky,
    shell: Shell,
    directions: Float64[np.ndarray, "M 3"],
    step: float,
    sh_degree: int,
    pixels: cKDTree,
) -> Gaussians:
    near = pixels.query(directions, k=range(1, min(VOTES, len(sky.colors)) + 1))[1]
    colors = np.median(sky.colors[near], axis=1)
    count = len(directions)
    along = math.log(SPLAT_WIDTH * step * shell.radius)
    scales = torch.tensor([along, along, along + math.log(FLATNESS)], dtype=torch.float32)
    return Gaussians(
        means=torch.tensor(shell.centre + shell.radius * directions, dtype=torch.float32),
        quats=torch.tensor(_facing(directions), dtype=torch.float32),
        log_scales=scales.repeat(count, 1),
        sh0=torch.tensor((colors - SH_OFFSET) / C0, dtype=torch.float32)[:, None],
        sh_rest=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        logit_opacities=torch.full((count,), math.log(OPACITY / (1 - OPACITY))),
    )


def _facing(directions: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 4"]:
    """Return quaternions (w, x, y, z) that turn the z axis to each direction."""
    x, y, z = directions.T
    quats = np.stack([1 + z, -y, x, np.zeros_like(x)], axis=1)
    quats[z < -0.999999] = (0.0, 1.0, 0.0, 0.0)
    return np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True))

"""Judge the splats of a scene by their shape and place alone, where there are no photos to judge them by.

This finds less than the photos do, and may be wrong: a distant tree is alone, a wall of one colour is large. It
proposes, and removes nothing.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from scipy.spatial import cKDTree

from gsplat_edu.base.constants import ALPHA_MIN
from gsplat_edu.scene.gaussians import Gaussians

LARGE = 0.5
"""A splat is too large if its largest standard deviation exceeds this fraction of the scene's extent: the longest side
of the box between the quantiles `INNER` of the centres."""

INNER = (0.1, 0.9)
"""See `LARGE`."""

NEIGHBOURS = 8
"""The distance to the neighbour of this rank says how alone a splat is."""

ALONE = 20.0
"""A splat is alone if that distance exceeds this multiple of its median and `OWN` times the splat's own size."""

OWN = 3.0
"""See `ALONE`; large splats far away have distant neighbours, too."""


class Shape(IntEnum):
    """What is unusual about a splat."""

    USUAL = 0
    INVISIBLE = 1
    LARGE = 2
    ALONE = 3

    @property
    def sentence(self) -> str:
        """The reason in words."""
        return SENTENCES[self]


SENTENCES = {
    Shape.USUAL: "usual",
    Shape.INVISIBLE: "never drawn: not finite, or fainter than 1/255",
    Shape.LARGE: "too large: wider than half of the scene",
    Shape.ALONE: "floating: far from all other splats",
}


def judge_shape(gaussians: Gaussians) -> UInt8[np.ndarray, " N"]:
    """Return a `Shape` for each of N splats; the first one that applies.

    Args:
        gaussians: N Gaussians on the CPU.
    """
    found = np.zeros(len(gaussians), dtype=np.uint8)
    drawn = gaussians.finite_rows().numpy() & (gaussians.opacities.detach().numpy() >= ALPHA_MIN)
    found[~drawn] = Shape.INVISIBLE
    rows = np.flatnonzero(drawn)
    means = gaussians.means.detach().double().numpy()[rows]
    sizes = torch.exp(gaussians.log_scales.detach().double().amax(dim=1)).numpy()[rows]
    if not len(rows):
        return found
    low, high = np.quantile(means, INNER, axis=0)
    found[rows[_alone(means, sizes)]] = Shape.ALONE
    found[rows[sizes > LARGE * (high - low).max()]] = Shape.LARGE
    return found


def _alone(means: Float64[np.ndarray, "N 3"], sizes: Float64[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
    """Return which of N splats are far from all others."""
    if len(means) <= NEIGHBOURS:
        return np.zeros(len(means), dtype=bool)
    apart = cKDTree(means).query(means, k=[NEIGHBOURS + 1])[0][:, 0]
    alone: Bool[np.ndarray, " N"] = (apart > ALONE * np.median(apart)) & (apart > OWN * sizes)
    return alone

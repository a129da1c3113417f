"""Halves the number of Gaussians: merges pairs that look alike, and keeps the moments of each pair.

A Gaussian of opacity o and covariance Sigma weighs m = o A, with A = sqrt(((tr Sigma)^2 - tr Sigma^2) / 2). For scales
a, b, c this is A = sqrt(a^2 b^2 + b^2 c^2 + c^2 a^2): its squared areas in three orthogonal projections, added up.
A pair becomes the Gaussian with the same moments:

    mu    = sum_i (m_i / m) mu_i,    m = sum_i m_i
    Sigma = sum_i (m_i / m) (Sigma_i + (mu_i - mu)(mu_i - mu)')
    sh    = sum_i (m_i / m) sh_i
    o     = min(m / A, 1 - (1 - o_1)(1 - o_2))

The first bound keeps the weight, o A = m. The second one holds where the two overlap: no pixel is covered more than by
both on top of each other.

Which pairs merge: each round finds the nearest neighbours of each Gaussian, prices every pair, and merges the pairs in
which each is the cheapest partner of the other, until half is left. So a dense cluster may lose more than half, and a
detail without an equal nearby stays. The price is m_1 m_2 / m times a shape term A / (A_1 + A_2), which is 1/2 for
copies and grows with the gap between the two, plus a colour term.

Nothing is random or depends on the number of threads: neighbours come from a k-d tree, ties go to the lower index.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsplat_edu.base.constants import C0
from gsplat_edu.scene.gaussian_math import quat_to_R_batch
from gsplat_edu.scene.gaussians import Gaussians

NEIGHBOURS = 8
"""Neighbours of a Gaussian that may become its partner."""

PASSES = 3
"""Passes over the pairs of a round. More passes need fewer rounds, but choose worse partners."""

COLOR_WEIGHT = 16.0
"""Weight of the squared difference of colours (0 to 1 per channel) relative to the shape term."""

LARGEST_LOG = 60.0
"""Logarithms of scales are clamped to +- this, so that products of four scales stay inside float64."""

FARTHEST = 1e30
"""Coordinates are clamped to +- this, world units, so that their squares stay finite."""

FAINTEST = 1e-12
"""Opacities count as at least this, so that every weight is positive; float32 logits keep it."""

MOST_OPAQUE = 1.0 - 2.0**-24
"""Largest opacity of a merged Gaussian, so that its logit is finite."""

FLATTEST = 1e-14
"""Smallest variance of a merged Gaussian relative to its largest one: a margin over the rounding of eigenvalues."""


@dataclass(frozen=True, eq=False)
class Blobs:
    """N Gaussians as float64 moments.

    Args:
        means: Centres, world units.
        covariances: Covariances, world units squared.
        opacities: In (0, 1).
        sh: Coefficients, degree 0 first, flattened.
    """

    means: Float64[np.ndarray, "N 3"]
    covariances: Float64[np.ndarray, "N 3 3"]
    opacities: Float64[np.ndarray, " N"]
    sh: Float64[np.ndarray, "N K"]

    @property
    def areas(self) -> Float64[np.ndarray, " N"]:
        """Area A of each."""
        return areas(self.covariances)

    @property
    def weights(self) -> Float64[np.ndarray, " N"]:
        """Weight m = o A of each."""
        weights: Float64[np.ndarray, " N"] = self.opacities * self.areas
        return weights


def areas(covariances: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, " N"]:
    """Return A = sqrt(((tr Sigma)^2 - tr Sigma^2) / 2) as a sum of minors, which cancels less.

    Args:
        covariances: N covariances, world units squared.

    Returns:
        Area of each Gaussian, world units squared.
    """
    a, b, c = (covariances[:, i, i] for i in range(3))
    d, e, f = covariances[:, 0, 1], covariances[:, 0, 2], covariances[:, 1, 2]
    squares = (a * b - d * d) + (a * c - e * e) + (b * c - f * f)
    covered: Float64[np.ndarray, " N"] = np.sqrt(np.maximum(squares, np.finfo(np.float64).tiny))
    return covered


def blobs_of(gaussians: Gaussians) -> Blobs:
    """Return the moments of Gaussians.

    Args:
        gaussians: N finite Gaussians; a quaternion of zero length counts as no rotation.

    Returns:
        Their moments.
    """
    values = {
        name: t.detach().numpy(force=True).astype(np.float64) for name, t in gaussians.tensors().items()
    }
    zero = ~values["quats"].any(axis=1)
    values["quats"][zero] = (1.0, 0.0, 0.0, 0.0)
    scales = np.exp(np.clip(values["log_scales"], -LARGEST_LOG, LARGEST_LOG))
    roots = quat_to_R_batch(values["quats"]) * scales[:, None, :]
    with np.errstate(over="ignore"):  # exp overflows to infinity: the opacity is 0
        opacities = 1.0 / (1.0 + np.exp(-values["logit_opacities"]))
    sh = np.concatenate([values["sh0"], values["sh_rest"]], axis=1)
    return Blobs(
        np.clip(values["means"], -FARTHEST, FARTHEST),
        roots @ roots.transpose(0, 2, 1),
        np.clip(opacities, FAINTEST, MOST_OPAQUE),
        sh.reshape(len(sh), sh.shape[1] * 3),
    )


def gaussians_of(blobs: Blobs) -> Gaussians:
    """Return N Gaussians, float32, with given moments.

    Args:
        blobs: The moments.
    """
    variances, axes = np.linalg.eigh(blobs.covariances)
    variances = np.maximum(variances, FLATTEST * variances[:, -1:])
    axes[np.linalg.det(axes) < 0, :, 0] *= -1.0  # a rotation, not a reflection
    quats = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]] if len(axes) else np.empty((0, 4))
    sh = blobs.sh.reshape(len(axes), blobs.sh.shape[1] // 3, 3)
    tensors = (
        blobs.means,
        quats,
        0.5 * np.log(variances),
        sh[:, :1],
        sh[:, 1:],
        np.log(blobs.opacities) - np.log1p(-blobs.opacities),
    )
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)) for array in tensors))


def merged_pairs(a: Blobs, b: Blobs) -> Blobs:
    """Merge row i of `a` with row i of `b`, by the equations of this module.

    Args:
        a: N Gaussians.
        b: N Gaussians.

    Returns:
        N Gaussians.
    """
    share = (a.weights / (a.weights + b.weights))[:, None]
    means = b.means + share * (a.means - b.means)
    apart = a.means - b.means
    spread = (share * (1.0 - share))[:, :, None] * (apart[:, :, None] * apart[:, None, :])
    covariances = share[:, :, None] * a.covariances + (1.0 - share)[:, :, None] * b.covariances + spread
    stacked = a.opacities + b.opacities - a.opacities * b.opacities
    opacities = np.minimum((a.weights + b.weights) / areas(covariances), stacked)
    return Blobs(
        means,
        covariances,
        np.clip(opacities, FAINTEST, MOST_OPAQUE),
        share * a.sh + (1.0 - share) * b.sh,
    )


def halved(gaussians: Gaussians) -> tuple[Gaussians, Int64[np.ndarray, " N"]]:
    """Merge N Gaussians into ceil(N / 2); see `merged_to`."""
    return merged_to(gaussians, -(-len(gaussians) // 2))


def merged_to(gaussians: Gaussians, target: int) -> tuple[Gaussians, Int64[np.ndarray, " N"]]:
    """Merge Gaussians into fewer.

    Args:
        gaussians: N finite Gaussians.
        target: Their number afterwards, at least 1; more than N leaves them as they are.

    Returns:
        The merged Gaussians, float32; Gaussians without a partner keep their bits. And for each of the N, the index of
        the result that contains it.
    """
    count = len(gaussians)
    owners = np.arange(count)
    blobs = blobs_of(gaussians)
    untouched = np.arange(count)  # row of the original; -1 if merged
    while len(blobs.means) > target:
        first, second = _partners(blobs)
        first, second = first[: len(blobs.means) - target], second[: len(blobs.means) - target]
        blobs, moved = _contracted(blobs, first, second)
        untouched[first] = -1
        untouched = np.delete(untouched, second)
        owners = moved[owners]
    kept = untouched >= 0
    merged = gaussians_of(blobs)
    original = gaussians.map(lambda tensor: tensor.detach().float()[torch.from_numpy(untouched[kept])])
    rows = torch.from_numpy(np.flatnonzero(kept))
    for name, tensor in merged.tensors().items():
        tensor[rows] = original.tensors()[name]
    return merged, owners


def _contracted(
    blobs: Blobs, first: Int64[np.ndarray, " P"], second: Int64[np.ndarray, " P"]
) -> tuple[Blobs, Int64[np.ndarray, " N"]]:
    """Merge pairs into the row of their first; return the rows that are left, and each row's new index."""
    arrays = [blobs.means, blobs.covariances, blobs.opacities, blobs.sh]
    pairs = merged_pairs(
        Blobs(*(array[first] for array in arrays)), Blobs(*(array[second] for array in arrays))
    )
    for array, part in zip(arrays, (pairs.means, pairs.covariances, pairs.opacities, pairs.sh), strict=True):
        array[first] = part
    stays = np.ones(len(blobs.means), dtype=bool)
    stays[second] = False
    moved = np.cumsum(stays) - 1
    moved[second] = moved[first]
    return Blobs(*(array[stays] for array in arrays)), moved


def _partners(blobs: Blobs) -> tuple[Int64[np.ndarray, " P"], Int64[np.ndarray, " P"]]:
    """Return disjoint pairs, at least one, cheapest first: each is the cheapest partner of the other.

    Gaussians without a partner are matched again among themselves, in `PASSES` passes in all. The cheapest pair always
    qualifies, so there is progress in every round.
    """
    count = len(blobs.means)
    near = min(NEIGHBOURS + 1, count)
    _, found = cKDTree(blobs.means).query(blobs.means, k=near)
    rows = np.repeat(np.arange(count), near)
    ends = np.sort(np.stack([rows, found.reshape(-1)], axis=1), axis=1)
    ends = ends[ends[:, 0] != ends[:, 1]]  # skip the point itself, which need not be first among equal points
    codes = np.sort(ends[:, 0].astype(np.int64) * count + ends[:, 1])
    codes = codes[np.diff(codes, prepend=-1) > 0]
    i, j = codes // count, codes % count
    order = np.argsort(_prices(blobs, i, j), kind="stable")
    i, j = i[order], j[order]
    pairs = []
    free = np.ones(count, dtype=bool)
    for _ in range(PASSES):
        rank = np.arange(len(i))
        best = np.full(count, len(i))
        np.minimum.at(best, i, rank)
        np.minimum.at(best, j, rank)
        chosen = (best[i] == rank) & (best[j] == rank)
        pairs.append(np.stack([i[chosen], j[chosen]]))
        free[pairs[-1]] = False
        left = free[i] & free[j]
        i, j = i[left], j[left]
    first, second = np.concatenate(pairs, axis=1)
    return first, second


def _prices(
    blobs: Blobs, i: Int64[np.ndarray, " E"], j: Int64[np.ndarray, " E"]
) -> Float64[np.ndarray, " E"]:
    """Return the price of each merge of rows i and j."""
    covered, weights = blobs.areas, blobs.weights
    colors = C0 * blobs.sh[:, :3]
    total = weights[i] + weights[j]
    share = weights[i] / total
    apart = blobs.means[i] - blobs.means[j]
    covariances = (
        share[:, None, None] * blobs.covariances[i] + (1 - share)[:, None, None] * blobs.covariances[j]
    )
    covariances += (share * (1 - share))[:, None, None] * (apart[:, :, None] * apart[:, None, :])
    shape = areas(covariances) / (covered[i] + covered[j])
    color = ((colors[i] - colors[j]) ** 2).sum(axis=1)
    prices: Float64[np.ndarray, " E"] = share * weights[j] * (shape + COLOR_WEIGHT * color)
    return prices

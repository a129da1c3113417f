"""Fit positions from GPS: scale in metres, and up.

x' = s R x + t maps the cameras' centres to east, north and up, in metres around their mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from gsplat_edu.io.edit import Similarity
from gsplat_edu.scene.earth import earth_centred, local_axes

FEWEST_PLACES = 6
"""Smallest number of photos with a position. A similarity has seven unknowns, and each position gives three numbers."""

LARGEST_MISFIT = 0.1
"""Use the scale only if the median distance between positions and cameras is at most this fraction of the positions'
spread. A phone's positions are off by 5 m, so they determine the scale of places larger than 50 m."""

LEAST_INLIERS = 0.6
"""Smallest fraction of the positions that must agree."""

TRIALS = 2000
"""Largest number of triples of positions that are tried; the first ones of a fixed random order."""

INLIER_SIGMAS = 3.0
"""A position agrees if its camera lies within this number of standard deviations."""

FINEST = 0.02
"""Lower bound of the standard deviation, m: the precision of RTK receivers."""

TILT = 0.05
"""Use the direction up only if its standard error is at most this, radians. Positions on a line do not determine it."""


class GpsFit(NamedTuple):
    """A fit of camera centres to positions.

    Args:
        move: From the cameras' world to east, north and up, m.
        inside: Which positions agree.
        residual: Median distance of all positions from their cameras, m.
        spread: Root mean square distance of the agreeing positions from their mean, m.
        tilt: Standard error of the direction up, radians.
    """

    move: Similarity
    inside: Bool[np.ndarray, " n"]
    residual: float
    spread: float
    tilt: float

    @property
    def good(self) -> bool:
        """Whether the positions determine the scale."""
        return bool(self.residual <= LARGEST_MISFIT * self.spread and self.inside.mean() >= LEAST_INLIERS)

    @property
    def error(self) -> float:
        """Standard error of the scale, as a fraction."""
        count = max(int(self.inside.sum()), 1)
        return float(self.residual / (self.spread * np.sqrt(count)))


def east_north_up(places: Sequence[tuple[float, float, float]]) -> Float64[np.ndarray, "n 3"]:
    """Convert positions to metres east, north and up (along the ellipsoid's normal at the first one), about their mean.

    Args:
        places: Latitude and longitude in degrees, and height in m, one per photo; at least one.
    """
    axes, middle = local_frame(places)
    return np.asarray((earth_centred(places) - middle) @ axes.T)


def local_frame(
    places: Sequence[tuple[float, float, float]],
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Return the axes, from earth-centred ones, and the earth-centred zero of `east_north_up`."""
    latitude, longitude, _ = places[0]
    return local_axes(latitude, longitude), earth_centred(places).mean(axis=0)


def similarity(a: Float64[np.ndarray, "n 3"], b: Float64[np.ndarray, "n 3"]) -> Similarity | None:
    """Return the similarity that maps points a to points b with the least squared distances; None if a are one point.

    Source: Umeyama 1991.
    """
    A, B = a - a.mean(axis=0), b - b.mean(axis=0)
    size = float((A**2).sum())
    if size == 0.0:
        return None
    U, S, Vt = np.linalg.svd(B.T @ A)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R, s = U @ np.diag(sign) @ Vt, float((S * sign).sum()) / size
    return Similarity(R, s, b.mean(axis=0) - s * R @ a.mean(axis=0)) if s > 0.0 else None


def fit_positions(eyes: Float64[np.ndarray, "n 3"], places: Float64[np.ndarray, "n 3"]) -> GpsFit | None:
    """Fit cameras to positions although some positions are wrong: least median of squares, then least squares.

    The triple of positions whose similarity has the smallest median distance starts; it is then refined on the
    positions within `INLIER_SIGMAS` standard deviations. The order of the triples is fixed, so results are repeatable.

    Args:
        eyes: Camera centres, world units.
        places: Their positions, m.

    Returns:
        The fit; None if there are fewer than `FEWEST_PLACES`, or all are in one place.
    """
    count = len(eyes)
    if count < FEWEST_PLACES or not np.ptp(places, axis=0).any():
        return None
    best, least = None, np.inf
    for triple in _triples(count):
        found = similarity(eyes[triple], places[triple])
        if found is not None and (median := float(np.median(_distances(found, eyes, places)))) < least:
            best, least = found, median
    if best is None:
        return None
    inside = np.ones(count, np.bool_)
    for _ in range(10):
        distances = _distances(best, eyes, places)
        # The median of a distance in three dimensions is 1.54 standard deviations of a coordinate.
        sigma = max(float(np.median(distances)) / 1.54, FINEST)
        now = distances <= INLIER_SIGMAS * 1.54 * sigma
        better = similarity(eyes[now], places[now]) if now.sum() >= 3 else None
        if better is None or np.array_equal(now, inside):
            break
        best, inside = better, now
    residual = float(np.median(_distances(best, eyes, places)))
    spread = float(np.sqrt(np.square(places[inside] - places[inside].mean(axis=0)).sum(axis=1).mean()))
    # The second largest extent of the positions resists a tilt about the largest one.
    extents = np.linalg.svd(places[inside] - places[inside].mean(axis=0), compute_uv=False)
    tilt = float(max(residual, FINEST) / extents[1]) if len(extents) > 1 and extents[1] > 0 else np.inf
    return GpsFit(best, inside, residual, spread, tilt)


def _triples(count: int) -> list[np.ndarray]:
    """Return triples of indices: all, or the first `TRIALS` of a fixed random order."""
    if count <= 20:
        return [np.array(triple) for triple in islice(combinations(range(count), 3), TRIALS)]
    rng = np.random.default_rng(0)
    return [rng.choice(count, 3, replace=False) for _ in range(TRIALS)]


def _distances(
    move: Similarity, eyes: Float64[np.ndarray, "n 3"], places: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, " n"]:
    return np.asarray(np.linalg.norm(move.s * eyes @ move.R.T + move.t - places, axis=1))

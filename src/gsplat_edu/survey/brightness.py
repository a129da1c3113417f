"""How much brighter a photo is than its neighbours, from ratios of what both show.

A difference counts only if it is larger than its error, and only if most neighbours show it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from gsplat_edu.io.mesh_glb import linear

ENOUGH = 3
"""A photo with fewer neighbours than this is not compared."""

JUMP = 0.4
"""Exposure jumps if it differs from the neighbours' by more than this, stops: a grey of 128 becomes 113, an error of
25 dB. Of 97 phone photos with automatic exposure, 93 stay below it."""

PAIRS = 20
"""Two photos are compared if they share at least this many points that are not clipped in either."""

AGREEING = 0.75
"""This share of the neighbours must show at least half of the difference, so that a shadow's edge does not count."""

ACROSS = 4
"""Cells across and down a photo. Points of one cell share their surface and its shading, so that they count as one
independent sample of the ratio of two photos."""

SIGMAS = 3.0
"""A difference counts only if it exceeds this multiple of its standard error, 1.25 * 1.48 MAD / sqrt(cells): gloss, and
points that one photo hides, spread the ratios; an exposure changes all of them by one factor."""


class Difference(NamedTuple):
    """How much brighter one photo is than another."""

    stops: float
    """The difference, stops."""
    error: float
    """Its standard error, stops; 0 if it is known from EXIF."""

    @property
    def is_certain(self) -> bool:
        """Whether the difference is not explained by its error."""
        return abs(self.stops) > SIGMAS * self.error


def occupied(at: Float64[np.ndarray, "n 2"], size: tuple[int, int]) -> int:
    """Count the cells of a photo that points lie in.

    Args:
        at: (n, 2) columns and rows, px; pixel centres have integer coordinates.
        size: The photo's width and height, px.
    """
    columns, rows = (np.clip((at[:, k] + 0.5) * ACROSS // size[k], 0, ACROSS - 1) for k in (0, 1))
    return len(np.unique(columns + ACROSS * rows))


def stops_between(
    here: Float[np.ndarray, "n 3"], there: Float[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return how much brighter colours are than others, stops: log2 of the ratio of their linear values.

    Args:
        here: (n, 3) sRGB, 0 to 255.
        there: (n, 3) the others.
    """
    return np.asarray(np.log2(linear(here / 255.0) / linear(there / 255.0)))


def difference_of(stops: Float64[np.ndarray, " n"], cells: int) -> Difference:
    """Return the median of ratios and its standard error: 1.25 sigma / sqrt(cells), sigma = 1.48 MAD.

    Args:
        stops: (n,) logarithms of ratios of brightness, base 2.
        cells: Number of independent samples among them (`occupied`).
    """
    median = float(np.median(stops))
    return Difference(median, 1.2533 * 1.4826 * float(np.median(np.abs(stops - median))) / math.sqrt(cells))


def agreed(differences: Sequence[Difference]) -> float:
    """Return the neighbours' median if it is certain and most of them show at least half of it, otherwise 0."""
    if len(differences) < ENOUGH:
        return 0.0
    values, errors = np.array(differences).T
    middle = Difference(float(np.median(values)), float(np.median(errors)))
    agree = np.mean(values * np.sign(middle.stops) > 0.5 * abs(middle.stops)) >= AGREEING
    return middle.stops if middle.is_certain and agree else 0.0

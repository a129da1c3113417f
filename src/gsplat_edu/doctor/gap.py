"""The widest arc around a common subject from which no photo was taken, and where to stand to close it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.paths.orbits import common_up
from gsplat_edu.survey.geometry import INWARD, Geometry

LEAST = math.radians(30.0)
"""Narrower arcs are no gap: photos 30 degrees apart still share most of what they show."""

HOLE = math.radians(60.0)
"""A wider gap is a hole in the scene: surfaces inside it are seen at more than 30 degrees to their normal, which
stretches them by half."""

FACTOR = 3.0
"""A gap is also wider than this multiple of the median arc between neighbouring cameras: an orbit of six photos has
none."""

ARC_STEP = math.radians(5.0)
"""Largest angle between two points of the drawn arc."""


@dataclass(frozen=True, eq=False)
class Ring:
    """The cameras around their common subject, in cylindrical coordinates about the vertical axis through it.

    Args:
        centre: (3,) the subject, world units.
        axes: (3, 3) rows: two horizontal axes, and up.
        azimuths: (C,) radians, -pi to pi.
        radii: (C,) distances from the axis, world units.
        heights: (C,) above the subject, world units.
    """

    centre: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    azimuths: Float64[np.ndarray, " C"]
    radii: Float64[np.ndarray, " C"]
    heights: Float64[np.ndarray, " C"]

    def __post_init__(self) -> None:
        """Order the cameras by azimuth."""
        order = np.argsort(self.azimuths, kind="stable")
        turned = self.azimuths[order]
        object.__setattr__(self, "order", order)
        object.__setattr__(self, "arcs", np.diff(np.r_[turned, turned[0] + 2.0 * math.pi]))

    order: Int64[np.ndarray, " C"] = field(init=False)
    """Indices of the cameras by azimuth."""
    arcs: Float64[np.ndarray, " C"] = field(init=False)
    """Angles from each camera in this order to the next, radians."""

    @property
    def elevations(self) -> Float64[np.ndarray, " C"]:
        """Angles above the horizontal plane through the subject, radians."""
        return np.asarray(np.arctan2(self.heights, self.radii))

    @property
    def widest(self) -> float:
        """The widest arc, radians."""
        return float(self.arcs.max())

    @property
    def ends(self) -> tuple[int, int]:
        """Indices of the cameras at the ends of the widest arc."""
        at = int(np.argmax(self.arcs))
        return int(self.order[at]), int(self.order[(at + 1) % len(self.order)])

    def has_gap(self, least: float) -> bool:
        """Return whether the widest arc is wider than an angle, radians, and than `FACTOR` times the median arc."""
        return self.widest > max(least, FACTOR * float(np.median(self.arcs)))


def ring_of(geometry: Geometry) -> Ring | None:
    """Return the cameras around their common subject; None if they do not look at one.

    Args:
        geometry: The cameras of a capture.
    """
    if geometry.arrangement != INWARD or geometry.centre is None:
        return None
    up = common_up(geometry.cameras)
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    across = np.cross(up, side)
    offsets = geometry.eyes - geometry.centre
    heights = offsets @ up
    radii = np.linalg.norm(offsets - heights[:, None] * up, axis=1)
    azimuths = np.arctan2(offsets @ across, offsets @ side)
    return Ring(geometry.centre, np.stack((side, across, up)), azimuths, radii, heights)


@dataclass(frozen=True, eq=False)
class Gap:
    """An arc around the subject without a camera.

    Args:
        angle: Its angle, radians.
        edges: Indices of the cameras at its two ends.
        arc: (k, 3) points along it, from the first of these cameras to the second, world units.
    """

    angle: float
    edges: tuple[int, int]
    arc: Float64[np.ndarray, "k 3"]

    @property
    def middle(self) -> Float64[np.ndarray, "3"]:
        """(3,) the place in the middle of the arc, world units."""
        return np.asarray(self.arc[len(self.arc) // 2])


def widest_gap(geometry: Geometry) -> Gap | None:
    """Return the widest arc around the common subject without a camera.

    Between its two ends, the arc's distance from the vertical axis through the subject and its height change linearly
    with the angle.

    Args:
        geometry: The cameras of a capture.

    Returns:
        The gap; None if the cameras do not look at a common subject, or if no arc is wide enough to be a gap.
    """
    ring = ring_of(geometry)
    if ring is None or not ring.has_gap(LEAST):
        return None
    first, last = ring.ends
    count = 2 * math.ceil(ring.widest / (2.0 * ARC_STEP)) + 1  # odd, so that one point is in the middle
    share = np.linspace(0.0, 1.0, count)[:, None]
    radius, height = ((1.0 - share) * v[first] + share * v[last] for v in (ring.radii, ring.heights))
    turn = ring.azimuths[first] + share * ring.widest
    arc = ring.centre + np.hstack((radius * np.cos(turn), radius * np.sin(turn), height)) @ ring.axes
    return Gap(ring.widest, (first, last), arc)


def gap_sentence(geometry: Geometry, gap: Gap | None, names: Sequence[str]) -> str:
    """Say where photos are missing around the subject, in one sentence.

    Args:
        geometry: The cameras of a capture.
        gap: Its widest gap; None if there is none.
        names: The cameras' names.
    """
    if gap is not None:
        one, other = (names[edge] for edge in gap.edges)
        degrees = math.degrees(gap.angle)
        return (
            f"No photo was taken in an arc of {degrees:.0f} degrees, between {one} and {other}: "
            "if that side of the subject is to be seen, stand at the mark."
        )
    if geometry.arrangement != INWARD or geometry.centre is None:
        return "The cameras do not look at a common point, so no gap around it can be shown."
    return "The photos leave no wide gap around their subject."

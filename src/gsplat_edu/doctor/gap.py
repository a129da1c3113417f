"""The widest arc around a common subject from which no photo was taken, and where to stand to close it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsplat_edu.doctor.geometry import INWARD, Geometry
from gsplat_edu.paths.orbits import common_up

LEAST = math.radians(30.0)
"""Narrower arcs are no gap: photos 30 degrees apart still share most of what they show."""

FACTOR = 3.0
"""A gap is also wider than this multiple of the median arc between neighbouring cameras."""

ARC_STEP = math.radians(5.0)
"""Largest angle between two points of the drawn arc."""


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
    if geometry.arrangement != INWARD or geometry.centre is None:
        return None
    centre, up = geometry.centre, common_up(geometry.cameras)
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    across = np.cross(up, side)
    offsets = geometry.eyes - centre
    azimuths = np.arctan2(offsets @ across, offsets @ side)
    order = np.argsort(azimuths, kind="stable")
    arcs = np.diff(np.r_[azimuths[order], azimuths[order[0]] + 2.0 * math.pi])
    widest = int(np.argmax(arcs))
    angle = float(arcs[widest])
    if angle <= max(LEAST, FACTOR * float(np.median(arcs))):
        return None
    first, last = int(order[widest]), int(order[(widest + 1) % len(order)])
    count = 2 * math.ceil(angle / (2.0 * ARC_STEP)) + 1  # odd, so that one point is in the middle
    share = np.linspace(0.0, 1.0, count)[:, None]
    heights = offsets @ up
    radii = np.linalg.norm(offsets - heights[:, None] * up, axis=1)
    radius, height = ((1.0 - share) * v[first] + share * v[last] for v in (radii, heights))
    turn = azimuths[first] + share * angle
    arc = centre + radius * (np.cos(turn) * side + np.sin(turn) * across) + height * up
    return Gap(angle, (first, last), arc)


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

"""Checks of the start cloud: points far outside, points no camera sees, too few of them."""

from __future__ import annotations

import numpy as np

from gsplat_edu.doctor.finding import Finding, Severity
from gsplat_edu.doctor.survey import Survey
from gsplat_edu.text import short_number

FAR = 20.0
"""Distance from the middle of the cloud, in the distance that four fifths of its points keep, from which a point is far
outside: the street behind a statue is not, a match gone wrong is."""

FAR_SHARE = 0.02
"""Share of such points from which it is told; a sky has some."""

UNSEEN_SHARE = 0.05
"""Share of points in no picture from which it is told: points found from photos are in two of them at least."""

FEW_POINTS = 200
"""Points below which the start is told to be poor: random ones are 100,000."""


def check_cloud(survey: Survey) -> list[Finding]:
    """Find start points that hinder more than they help."""
    points = survey.points
    if not len(points):
        return []
    found = []
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    far = float(np.mean(distances > FAR * np.quantile(distances, 0.8)))
    if far > FAR_SHARE:
        what = f"{short_number(100 * far, 2)} % of the points lie far outside the scene"
        advice = "remove the points far outside: they become splats that nothing holds in place"
        found.append(Finding("far points", Severity.WARNING, what, advice))
    unseen = float(np.mean(~survey.geometry.in_sight.any(axis=0)))
    if unseen > UNSEEN_SHARE:
        what = f"{short_number(100 * unseen, 2)} % of the points lie in no camera's picture"
        advice = "check that the points belong to these poses: a point found from photos is visible in some of them"
        found.append(Finding("unseen points", Severity.WARNING, what, advice))
    if len(points) < FEW_POINTS:
        what = f"{len(points)} points are few to start from"
        advice = "match the photos again with more features; few start points leave much to chance"
        found.append(Finding("few points", Severity.NOTE, what, advice))
    return found

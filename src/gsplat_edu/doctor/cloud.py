"""Checks of the start points: distant points, points outside every view, too few points."""

from __future__ import annotations

import numpy as np

from gsplat_edu.base.text import short_number
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.finding import Finding, Severity

FAR = 20.0
"""A point is far outside if its distance from the cloud's median exceeds this multiple of the 80th percentile. The
street behind a statue is not far outside; a wrong match is."""

FAR_SHARE = 0.02
"""Warn when the share of such points exceeds this; a sky has some."""

UNSEEN_SHARE = 0.05
"""Warn when the share of points outside every view exceeds this: a triangulated point is visible in at least two."""

FEW_POINTS = 200
"""Report fewer start points than this; a random start has 100,000."""


def check_cloud(survey: Survey) -> list[Finding]:
    """Find start points that do more harm than good."""
    points = survey.points
    if not len(points):
        return []
    found = []
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    far = float(np.mean(distances > FAR * np.quantile(distances, 0.8)))
    if far > FAR_SHARE:
        what = f"{short_number(100 * far, 2)} % of the points lie far outside the scene"
        advice = "remove the points far outside: they become splats that no photo constrains"
        found.append(Finding("far points", Severity.WARNING, what, advice, certain=True))
    unseen = float(np.mean(~survey.geometry.in_sight.any(axis=0)))
    if unseen > UNSEEN_SHARE:
        what = f"{short_number(100 * unseen, 2)} % of the points lie outside every camera's view"
        advice = "check that the points belong to these poses: a triangulated point is visible in some photos"
        found.append(Finding("unseen points", Severity.WARNING, what, advice, certain=True))
    if len(points) < FEW_POINTS:
        what = f"{len(points)} points are few to start from"
        advice = (
            "match the photos again with more features: few start points make the result depend on chance"
        )
        found.append(Finding("few points", Severity.NOTE, what, advice))
    return found

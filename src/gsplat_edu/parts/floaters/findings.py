"""The finding about splats that float close to a camera."""

from __future__ import annotations

from gsplat_edu.base.text import Told
from gsplat_edu.survey.finding import Finding, Severity, counted
from gsplat_edu.survey.trained import Trained

VEILED = 0.02
"""Warn if near splats cover more than this fraction of a view's pixels: a spot of a seventh of its width and height."""


def check_floaters(run: Trained) -> list[Finding]:
    """Report views that floaters cover."""
    veiled = sorted((v for v in (*run.train, *run.test) if v.veiled > VEILED), key=lambda view: -view.veiled)
    if not veiled:
        return []
    names = tuple(view.name for view in veiled)
    shares = tuple(f"{100 * view.veiled:.0f} %" for view in veiled)
    what = f"{counted(len(veiled), 'view')} with splats floating close to the camera"
    fewer = "they are fewer with real start points and no exposure jumps"
    advice = Told(
        f"remove them with gsplat-edu clean, or train with --clean; {fewer}",
        f"remove them with Clean under Share; {fewer}",
    )
    return [Finding("floaters", Severity.WARNING, what, advice, names, shares)]

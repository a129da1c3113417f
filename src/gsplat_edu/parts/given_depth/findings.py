"""Checks of the depth that the user has: maps that do not fit the points, missing ones, and photos with few points."""

from __future__ import annotations

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import Told
from gsplat_edu.data.depth_fit import DepthMisfitError
from gsplat_edu.data.depths import FEW_POINTS, POINTS, DepthReport
from gsplat_edu.survey.finding import Finding, Severity

NAME = "depth"
"""Name of the check, of its findings and of the fact."""

FEW_SHARE = 0.2
"""Warn when more than this fraction of the photos have few points."""


def depth_findings(depth: DepthReport | DatasetError) -> list[Finding]:
    """Report what is wrong with the depth of a capture.

    Args:
        depth: What was found about it, or why it cannot be used.
    """
    if isinstance(depth, DepthReport):
        return _check_report(depth)
    if isinstance(depth, DepthMisfitError):
        what = f"the depth maps do not fit: {depth.reason}"
        return [Finding(NAME, Severity.WARNING, what, depth.advice)]
    repair = "repair what the depth check names"
    advice = Told(f"{repair}, or train without --depth", f"{repair}, or train without depth")
    return [Finding(NAME, Severity.WARNING, str(depth), advice)]


def _check_report(report: DepthReport) -> list[Finding]:
    """Report what is missing from depth that can be used, and which maps are left out."""
    found = list[Finding]()
    if report.rejected:
        found.append(
            Finding(
                NAME,
                Severity.WARNING,
                f"{len(report.rejected)} of {report.photos} depth maps disagree with the points that their photos see",
                "check that these maps belong to their photos, not turned or cropped; training leaves them out",
                tuple(name for name, _ in report.rejected),
                tuple(reason for _, reason in report.rejected),
            )
        )
    fit = report.fit
    if report.missing and report.source == POINTS:
        grave = len(report.missing) > FEW_SHARE * report.photos
        found.append(
            Finding(
                NAME,
                Severity.WARNING if grave else Severity.NOTE,
                f"{len(report.missing)} of {report.photos} photos see fewer than {FEW_POINTS} points that give depth",
                "take more photos between these and their neighbours, so that matching finds more points",
                report.missing,
            )
        )
    elif report.missing:
        advice = "add the missing maps under their photos' names; training uses the others"
        what = f"{len(report.missing)} of {report.photos} photos have no depth map"
        found.append(Finding(NAME, Severity.NOTE, what, advice, report.missing))
    if fit is not None and not fit.points:
        what = "no points lie where the maps have depth, so nothing checks their unit"
        found.append(Finding(NAME, Severity.NOTE, what, "compare a known distance after a short training"))
    elif fit is not None and not fit.certain:
        what = "the photos see too narrow an angle to tell camera depth (z) from lengths of rays"
        look = "look up what the device writes"
        advice = Told(
            f"{look}, and train with --set depth_kind=z or depth_kind=ray",
            f"{look}; training from the command line has a setting that says which of the two the maps hold",
        )
        found.append(Finding(NAME, Severity.NOTE, what, advice))
    return found

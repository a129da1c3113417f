"""Checks of the depth that the user has: maps that do not fit the points, missing ones, and photos with few points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import Told
from gsplat_edu.data.capture import is_folder
from gsplat_edu.data.depth_fit import DepthMisfitError
from gsplat_edu.data.depth_folder import GEOMETRIC_MAPS
from gsplat_edu.data.depths import CAPTURE, FEW_POINTS, POINTS, DepthReport, DepthSource, judged_depths
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.finding import Finding, Severity
from gsplat_edu.scene.camera import Camera

NAME = "depth"
"""Name of the findings."""

FEW_SHARE = 0.2
"""Warn when more than this fraction of the photos have few points."""


def own_depth(reader: CaptureReader) -> Path | None:
    """Return the source of the depth maps that a capture brings along; None if it has none."""
    named = any(frame.depth is not None for frame in reader.capture.frames)
    return CAPTURE if named or is_folder(reader.path / GEOMETRIC_MAPS) else None


def judge_depth(
    reader: CaptureReader, cameras: Sequence[tuple[str, Camera]], path: Path
) -> tuple[DepthReport | None, list[Finding]]:
    """Read all depth of a capture, and report what is wrong with it.

    Args:
        reader: The capture.
        cameras: Name and camera of each readable photo.
        path: Where depth comes from; see `DepthSource`.

    Returns:
        What was found, None if nothing can be used; and the findings.
    """
    try:
        report = judged_depths(reader, cameras, DepthSource(path)).report
    except DepthMisfitError as error:
        return None, [
            Finding(NAME, Severity.WARNING, f"the depth maps do not fit: {error.reason}", error.advice)
        ]
    except DatasetError as error:
        repair = "repair what the depth check names"
        advice = Told(f"{repair}, or train without --depth", f"{repair}, or train without depth")
        return None, [Finding(NAME, Severity.WARNING, str(error), advice)]
    return report, check_depth(report)


def check_depth(report: DepthReport) -> list[Finding]:
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

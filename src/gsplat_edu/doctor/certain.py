"""Findings about a capture that are certain without its pixels: `train`, `sfm` and the studio say what `doctor` says.

Lists, poses, headers and points prove them, so that no photo is decoded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from gsplat_edu.data.capture import Frame
from gsplat_edu.data.left_out import is_left_out, photo_path, read_left_out
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.doctor.cameras import TURN, check_intrinsics, check_parallax, check_wrong_poses
from gsplat_edu.doctor.cloud import check_cloud
from gsplat_edu.doctor.files import check_poses, check_usable
from gsplat_edu.doctor.gap import HOLE, widest_gap
from gsplat_edu.survey.capture import Survey, survey_of_poses
from gsplat_edu.survey.finding import Finding, Severity

OF_VIEWS: tuple[Callable[[Survey], list[Finding]], ...] = (
    check_parallax,
    check_intrinsics,
    check_wrong_poses,
    check_cloud,
)
"""Checks without pixels that compare views; they need at least two."""


def certain_findings(reader: CaptureReader, left_out: Sequence[str] | None = None) -> tuple[Finding, ...]:
    """Return the warnings about a capture that are certain without its pixels, most serious first.

    It takes about a second for 1,000 photos.

    Args:
        reader: The capture.
        left_out: Photos that are not used; None uses the capture's own list.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read. Unreadable photos raise no error.
    """
    survey = survey_of_poses(reader, left_out)
    checks = (check_usable, *(OF_VIEWS if len(survey.shots) > 1 else ()), check_poses)
    found = [finding for check in checks for finding in check(survey)]
    chosen = [finding for finding in found if finding.certain and finding.severity > Severity.NOTE]
    return tuple(sorted(chosen, key=lambda finding: -finding.severity))


def known_photos(reader: CaptureReader, left_out: Sequence[str] | None = None) -> dict[str, Any]:
    """Return what the verdict on a run has to know about its photos, for config.json.

    Args:
        reader: The capture.
        left_out: Photos that are not used; None uses the capture's own list.

    Returns:
        unposed, the number of photos without a pose; and if an orbit around the subject has a gap, the names of the two
        photos beside it as gap, and as hole whether the scene is unknown there.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read. Unreadable photos raise no error.
    """
    survey = survey_of_poses(reader, left_out)
    known: dict[str, Any] = {"unposed": len(survey.unposed)}
    gap = widest_gap(survey.geometry) if len(survey.shots) > 1 else None
    if gap is not None and 2.0 * math.pi - gap.angle >= TURN:
        known |= {"gap": [survey.names[edge] for edge in gap.edges], "hole": gap.angle > HOLE}
    return known


def without_wrong_poses(reader: CaptureReader, findings: Sequence[Finding]) -> tuple[str, ...] | None:
    """Return the photos that a training leaves out: the capture's list, and those whose pose is certainly wrong.

    Args:
        reader: The capture.
        findings: Its certain findings.

    Returns:
        For `gsplat_edu.data.settings.DataSettings.left_out`; None if no pose is certainly wrong, or if nothing would be
        left to train on.
    """
    wrong = {name for finding in findings if finding.leaves_out for name in finding.images}
    if not wrong:
        return None
    frames: Sequence[Frame] = reader.capture.frames
    listed = read_left_out(reader.path)
    chosen = (*listed, *(photo_path(frame, reader.path) for frame in frames if frame.name in wrong))
    return None if all(is_left_out(frame, reader.path, chosen) for frame in frames) else chosen

"""Checks of the files: photos missing, damaged or without a pose, and too few of them."""

from __future__ import annotations

from gsplat_edu.data.notes import MissingPhotos
from gsplat_edu.doctor.finding import Finding, Severity, counted, listed
from gsplat_edu.doctor.survey import Survey

FEW = 12
"""Photos below which a scene is told to be seen by few: a turn of as many has 30 degrees between neighbours, about as
far as features are matched."""

UNPOSED = 0.1
"""Share of photos without a pose from which it is a warning: some always fail, a tenth is a part of the scene."""


def check_usable(survey: Survey) -> list[Finding]:
    """Find captures with no photo, one, or few that can be trained on."""
    count, total = len(survey.shots), len(survey.shots) + len(survey.refused)
    if count < 2:
        what = f"{count} of {total} photos can be used, and a scene needs several views of it"
        return [
            Finding(
                "usable", Severity.FATAL, what, "take or copy the photos again: training needs at least two"
            )
        ]
    if count < FEW:
        return [
            Finding(
                "few photos",
                Severity.WARNING,
                f"{count} photos are few: the scene between them is guessed",
                f"take more photos: at least {FEW}, better 30 or more, each sharing most of its picture with the next",
            )
        ]
    return []


def check_missing(survey: Survey) -> list[Finding]:
    """Find photos that the capture lists and that are not there."""
    return [
        Finding(
            "missing",
            Severity.WARNING,
            f"{counted(note.missing, 'missing image')} of {note.total} listed, first {note.first}",
            "copy the missing photos to where the capture lists them, or go on without them",
        )
        for note in survey.notes
        if isinstance(note, MissingPhotos)
    ]


def check_readable(survey: Survey) -> list[Finding]:
    """Find photos that cannot be decoded, or that do not fit their camera: training would refuse the capture."""
    if not survey.refused:
        return []
    names = [photo.name for photo in survey.refused]
    reasons = "; ".join(dict.fromkeys(photo.reason for photo in survey.refused[:3]))
    return [
        Finding(
            "unusable",
            Severity.WARNING,
            f"{len(names)} of {len(survey.shots) + len(names)} photos ({reasons})",
            f"copy {listed(names)} again, calibrate again or take them out: training refuses the capture as it is",
            tuple(names),
        )
    ]


def check_poses(survey: Survey) -> list[Finding]:
    """Find photos that have no pose."""
    if not survey.unposed:
        return []
    total = len(survey.unposed) + len(survey.shots) + len(survey.refused)
    grave = len(survey.unposed) >= UNPOSED * total
    return [
        Finding(
            "no pose",
            Severity.WARNING if grave else Severity.NOTE,
            f"{len(survey.unposed)} of {total} photos in the folder, not used",
            "find poses for the photos that have none: more overlap with their neighbours, or another matching",
            survey.unposed,
        )
    ]

"""Checks of the files: missing or damaged photos, photos without a pose, and too few photos."""

from __future__ import annotations

from gsplat_edu.data.notes import MissingPhotos
from gsplat_edu.evaluate.verdict import UNPOSED
from gsplat_edu.survey.capture import Survey
from gsplat_edu.survey.finding import Finding, Severity, counted, listed

FEW = 12
"""Warn about fewer photos than this: on an orbit of 12, neighbours are 30 degrees apart, about the limit of feature
matching."""


USUAL = (40, 150)
"""Usual numbers of photos of a thing or a room, smallest and largest, as docs/TOUR.md advises."""


def check_usable(survey: Survey) -> list[Finding]:
    """Find captures with too few usable photos."""
    return too_few(len(survey.shots), len(survey.shots) + len(survey.refused))


def too_few(count: int, total: int) -> list[Finding]:
    """Find whether photos are too few.

    Args:
        count: Photos that can be used.
        total: All photos.
    """
    if count < 2:
        what = f"{count} of {total} photos can be used, but a scene needs several views"
        return [
            Finding(
                "usable",
                Severity.FATAL,
                what,
                "take or copy the photos again: training needs at least two",
                certain=True,
            )
        ]
    if count < FEW:
        return [
            Finding(
                "few photos",
                Severity.WARNING,
                f"{count} photos are few: the scene between them is guessed",
                f"take more photos: at least {FEW}, usually {USUAL[0]} to {USUAL[1]}, each sharing most of its"
                " view with the next",
                certain=True,
            )
        ]
    return []


def check_missing(survey: Survey) -> list[Finding]:
    """Find photos that the capture lists but that do not exist."""
    return [
        Finding(
            "missing",
            Severity.WARNING,
            f"{counted(note.photos, 'missing image')} of {note.total} listed, first {note.first}",
            "copy the missing photos to where the capture lists them, or train without them",
        )
        for note in survey.notes
        if isinstance(note, MissingPhotos)
    ]


def check_readable(survey: Survey) -> list[Finding]:
    """Find photos that cannot be decoded or do not fit their camera; training refuses such a capture."""
    if not survey.refused:
        return []
    names = [photo.name for photo in survey.refused]
    reasons = "; ".join(dict.fromkeys(photo.reason for photo in survey.refused[:3]))
    return [
        Finding(
            "unusable",
            Severity.WARNING,
            f"{len(names)} of {len(survey.shots) + len(names)} photos ({reasons})",
            f"copy {listed(names)} again, recalibrate or remove them: training refuses the capture as it is",
            tuple(names),
        )
    ]


def check_poses(survey: Survey) -> list[Finding]:
    """Find photos without a pose."""
    if not survey.unposed:
        return []
    total = len(survey.unposed) + len(survey.shots) + len(survey.refused)
    serious = len(survey.unposed) >= UNPOSED * total
    return [
        Finding(
            "no pose",
            Severity.WARNING if serious else Severity.NOTE,
            f"{len(survey.unposed)} of {total} photos could not be placed, and are not used",
            "take two more photos beside each of those that were not placed, and find the poses again",
            survey.unposed,
            certain=True,
        )
    ]

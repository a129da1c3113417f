"""Checks of the files: photos missing, damaged or without a pose, and too few of them."""

from __future__ import annotations

import re

from gsplat_edu.doctor.finding import Finding, Severity, counted, listed
from gsplat_edu.doctor.survey import Survey

FEW = 12
"""Photos below which a scene is told to be seen by few: a turn of as many has 30 degrees between neighbours, about as
far as features are matched."""

UNPOSED = 0.1
"""Share of photos without a pose from which it is a warning: some always fail, a tenth is a part of the scene."""

_MISSING = re.compile(r"(\d+) of (\d+) photos have no file: skipped, first (.*)")
"""As `gsplat_edu.data.capture.missing_note` says it."""


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
    found = next((match for note in survey.notes if (match := _MISSING.fullmatch(note))), None)
    if found is None:
        return []
    missing, total, first = found.groups()
    return [
        Finding(
            "missing",
            Severity.WARNING,
            f"{counted(int(missing), 'missing image')} of {total} listed, first {first}",
            "copy the missing photos to where the capture lists them, or go on without them",
        )
    ]


def is_missing(note: str) -> bool:
    """Say whether a reader's note is what `check_missing` tells."""
    return _MISSING.fullmatch(note) is not None


def check_readable(survey: Survey) -> list[Finding]:
    """Find photos that cannot be decoded, or that do not fit their camera: training would refuse the capture."""
    if not survey.refused:
        return []
    names = [name for name, _ in survey.refused]
    reasons = "; ".join(dict.fromkeys(_reason(why) for _, why in survey.refused[:3]))
    return [
        Finding(
            "unusable",
            Severity.WARNING,
            f"{len(names)} of {len(survey.shots) + len(names)} photos ({reasons})",
            f"copy {listed(names)} again, calibrate again or take them out: training refuses the capture as it is",
            tuple(names),
        )
    ]


def _reason(message: str) -> str:
    """Shorten an error's line to why: what stands in brackets, or before the first semicolon without the file."""
    inner = re.search(r"cannot be decoded \((.*)\);", message)
    short = inner[1] if inner else message.split("; ")[0].rpartition(": ")[2]
    return re.sub(r"^the photo of .* is (?=\d)", "the photo is ", short)


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

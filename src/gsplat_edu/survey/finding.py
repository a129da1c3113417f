"""Findings: what is wrong with a capture or a run, how serious it is, and what to do about it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

NAMED = 3
"""Number of images that a finding names; the others are counted."""


class Severity(IntEnum):
    """How serious a finding is."""

    NOTE = 1
    """Worth knowing; no action needed."""
    WARNING = 2
    """Training works, but the scene gets worse."""
    FATAL = 3
    """Training is pointless."""


class Change(NamedTuple):
    """What a piece of advice changes. Two pieces contradict each other if they turn one quantity in different ways."""

    quantity: str
    """For example photos used, photos taken, iterations, Gaussians, sky."""
    direction: str
    """For example more, fewer, all, on."""


MORE_PHOTOS, FEWER_PHOTOS, ALL_PHOTOS = (
    Change("photos taken", "more"),
    Change("photos used", "fewer"),
    Change("photos used", "all"),
)
LONGER, SHORTER, AS_LONG = (Change("iterations", direction) for direction in ("more", "fewer", "same"))
MORE_SPLATS, FEWER_SPLATS = (Change("Gaussians", direction) for direction in ("more", "fewer"))


@dataclass(frozen=True)
class Finding:
    """One problem.

    Args:
        name: One or two words.
        severity: How serious it is.
        sentence: The problem, with numbers.
        advice: What to do about it.
        images: Names of the affected images; empty if the whole capture is affected.
        values: A measured value for each of these images, as text; empty if there is none.
        options: Options of `train`, by their names in Python, and the values that the advice proposes; empty if it
            proposes none.
        changes: What the advice changes.
        certain: Whether the capture's lists, poses, headers and points alone prove it
            (`gsplat_edu.doctor.certain.certain_findings`).
        leaves_out: Whether a training leaves these images out by itself.
    """

    name: str
    severity: Severity
    sentence: str
    advice: str
    images: tuple[str, ...] = ()
    values: tuple[str, ...] = ()
    options: tuple[tuple[str, str], ...] = ()
    changes: tuple[Change, ...] = ()
    certain: bool = False
    leaves_out: bool = False

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the images, each followed by its value in brackets if there are values."""
        if not self.values:
            return self.images
        return tuple(f"{name} ({value})" for name, value in zip(self.images, self.values, strict=True))


@dataclass(frozen=True)
class Remedy:
    """A choice and its reason.

    Args:
        value: What to pass to the option.
        reason: Why, as a clause that follows the option; "" if there is nothing to tell.
    """

    value: str
    reason: str = ""


class Examined(NamedTuple):
    """What a part of a training finds in a capture or in a run."""

    checks: Mapping[str, Sequence[Finding]] = {}
    """Findings by the name of the check; a check without findings is listed as fine."""
    facts: Sequence[tuple[str, str]] = ()
    """(name, value) pairs that describe the capture or the run."""


def command(*words: str | Path) -> str:
    """Return a gsplat-edu command quoted for the shell, safe for any file name."""
    # a file name that begins with a dash would be parsed as an option
    spelled = [
        f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word) for word in words
    ]
    return shlex.join(["gsplat-edu", *spelled])


def counted(number: int, word: str) -> str:
    """Return a number with its noun: 1 pair, 2 pairs."""
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def listed(names: Sequence[str]) -> str:
    """Name the first images of a list and count the others."""
    shown = ", ".join(names[:NAMED])
    return shown if len(names) <= NAMED else f"{shown} and {len(names) - NAMED} more"

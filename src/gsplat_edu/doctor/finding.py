"""What the doctor finds: a sentence, what to do about it, and how much it matters."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

ADVICE = 3
"""Pieces of advice a diagnosis ends with: more than three are not followed."""

NAMED = 3
"""Images that a sentence names; the others are counted."""


class Severity(IntEnum):
    """How much a finding matters."""

    NOTE = 1
    """Worth knowing; nothing has to be done."""
    WARNING = 2
    """Training works, but the scene suffers."""
    FATAL = 3
    """Training is pointless."""


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Args:
        name: One or two words.
        severity: How much it matters.
        sentence: What was found, with numbers.
        advice: What to do about it.
        images: Names of the images concerned; none where it is the whole capture.
        values: What was measured of each of these images, in words; empty where there is nothing to add.
    """

    name: str
    severity: Severity
    sentence: str
    advice: str
    images: tuple[str, ...] = ()
    values: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """The images' names, each with its value in brackets where there are values."""
        if not self.values:
            return self.images
        return tuple(f"{name} ({value})" for name, value in zip(self.images, self.values, strict=True))


@dataclass(frozen=True)
class Diagnosis:
    """All that was found.

    Args:
        facts: Names and values that say what was looked at.
        findings: In the order of the checks, the most harmful kind first.
        fine: Names of the checks that found nothing.
        otherwise: Advice to end with where warnings give fewer than three; the first is what comes next.
    """

    facts: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]
    fine: tuple[str, ...]
    otherwise: tuple[str, ...]

    @property
    def hopeless(self) -> bool:
        """Whether training would be pointless."""
        return any(finding.severity is Severity.FATAL for finding in self.findings)

    @property
    def ranked(self) -> list[Finding]:
        """The findings, the gravest first; equally grave ones in the order of the checks."""
        return sorted(self.findings, key=lambda finding: -finding.severity)

    @property
    def advice(self) -> list[str]:
        """The three most useful pieces of advice: of warnings, what comes next, of notes; no sentence twice."""
        grave = [finding.advice for finding in self.ranked if finding.severity > Severity.NOTE]
        slight = [finding.advice for finding in self.findings if finding.severity is Severity.NOTE]
        given = grave if self.hopeless else [*grave, *self.otherwise[:1], *slight, *self.otherwise[1:]]
        return list(dict.fromkeys(given))[:ADVICE]


def command(*words: str | Path) -> str:
    """Write a command of ours so that it can be pasted into a shell, whatever the names of files hold."""
    # a file whose name begins with a dash would be taken for an option
    spelled = [
        f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word) for word in words
    ]
    return shlex.join(["gsplat-edu", *spelled])


def new_run(name: str) -> Path:
    """Propose a folder for a run, out/NAME or out/NAME_2 and so on: one that is not there yet."""
    proposed, copy = Path("out") / name, 2
    while proposed.exists():
        proposed, copy = Path("out") / f"{name}_{copy}", copy + 1
    return proposed


def counted(number: int, word: str) -> str:
    """Write a number and its noun: 1 pair, 2 pairs."""
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def listed(names: Sequence[str]) -> str:
    """Name the first images of a list, and count the others."""
    shown = ", ".join(names[:NAMED])
    return shown if len(names) <= NAMED else f"{shown} and {len(names) - NAMED} more"


def diagnosis_lines(diagnosis: Diagnosis) -> list[str]:
    """Return a diagnosis as lines of text, up to its advice, which `advice_lines` gives."""
    rows = [*diagnosis.facts]
    rows += [(finding.severity.name.lower(), _told(finding)) for finding in diagnosis.ranked]
    if diagnosis.fine:
        rows.append(("fine", ", ".join(diagnosis.fine)))
    return table_lines(rows)


def advice_lines(diagnosis: Diagnosis) -> list[str]:
    """Return the advice as lines of text, numbered."""
    return ["what to do:", *(f"  {number}. {text}" for number, text in enumerate(diagnosis.advice, 1))]


def table_lines(rows: Iterable[tuple[str, str]]) -> list[str]:
    """Return names and values as lines, the values below one another."""
    return [f"{name:<10} {value}".rstrip() for name, value in rows]


def _told(finding: Finding) -> str:
    images = f": {listed(finding.labels)}" if finding.images else ""
    return f"{finding.name}: {finding.sentence}{images}"

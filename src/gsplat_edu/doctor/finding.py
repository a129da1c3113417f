"""Findings of the doctor: what is wrong, how serious it is, and what to do about it."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

from gsplat_edu.base.text import plain_of
from gsplat_edu.data.notes import Note
from gsplat_edu.evaluate.verdict import RANKED
from gsplat_edu.jobs.events import Found

ADVICE = 3
"""Number of pieces of advice at the end of a diagnosis; users do not follow more than three."""

NAMED = 3
"""Number of images that a finding names; the others are counted."""


CAUSES = (
    *("usable", "no parallax", "unusable", "missing", "wrong poses", "intrinsics", "sizes"),
    *("doubtful poses", "facing away", "splats", "same photo", "duplicates", "same pose", "white balance"),
    *RANKED,
    *("far points", "unseen points", "few points", "depth", "unexplained"),
    *("moved", "outside cut-outs", "floaters", "huge splats", "one side", "one height", "sky", "masks"),
    *("resolution", "faint splats", "plug-in"),
)
"""Names of the findings, causes before what they cause; the verdict ranks those of a run. Of two pieces of advice that
contradict each other, that of the more serious finding counts, and of equally serious ones that of the earlier in this
order."""

EXPLAINS = {
    "wrong poses": ("facing away", "hole", "poor fit"),
    "unfinished": ("short training", "poor fit", "unexplained", "overfitted", "floaters"),
    "moving subject": ("unexplained", "overfitted", "moved", "floaters"),
    "overfitted": ("short training",),
    "few photos": ("short training",),
}
"""Findings that another one explains, so that their own advice is left out: what to do about the cause comes first."""


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


class Advice(NamedTuple):
    """A piece of advice."""

    text: str
    """What to do."""
    changes: tuple[Change, ...] = ()
    """What it changes."""


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


@dataclass(frozen=True)
class Diagnosis:
    """The result of all checks.

    Args:
        described: (name, value) pairs that describe the capture or run.
        findings: In the order of the checks, most harmful kind first; advice that contradicts another finding's, or
            that another finding explains, is taken out (`reconciled`).
        fine: Names of the checks that found nothing.
        otherwise: Advice to add if the warnings give fewer than three pieces; the first is the next step.
        notes: Notes about the capture.
    """

    described: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]
    fine: tuple[str, ...]
    otherwise: tuple[Advice, ...]
    notes: tuple[Note, ...] = ()

    def __post_init__(self) -> None:
        """Reconcile the advice of the findings."""
        object.__setattr__(self, "findings", reconciled(self.findings))

    @property
    def facts(self) -> tuple[tuple[str, str], ...]:
        """The rows to show: `described`, then a sentence for each note, without a name."""
        return (*self.described, *(("", str(note)) for note in self.notes))

    @property
    def hopeless(self) -> bool:
        """Whether training would be pointless."""
        return any(finding.severity is Severity.FATAL for finding in self.findings)

    @property
    def ranked(self) -> list[Finding]:
        """The findings, most serious first; equally serious ones in the order of `CAUSES`."""
        return sorted(self.findings, key=_rank)

    @property
    def advice(self) -> list[str]:
        """The three most useful pieces of advice: for warnings, then the next step, then for notes; no duplicates.

        None contradicts another.
        """
        grave, slight = (
            [
                Advice(one.advice, one.changes)
                for one in self.ranked
                if (one.severity > Severity.NOTE) == is_grave
            ]
            for is_grave in (True, False)
        )
        given = grave if self.hopeless else [*grave, *self.otherwise[:1], *slight, *self.otherwise[1:]]
        chosen = list[Advice]()
        for one in given:
            if one.text and not any(one.text == other.text or contradict(one, other) for other in chosen):
                chosen.append(one)
        return [one.text for one in chosen[:ADVICE]]


def contradict(one: Advice | Finding, other: Advice | Finding) -> bool:
    """Return whether two pieces of advice turn the same quantity in different ways."""
    turned = dict(one.changes)
    return any(turned.get(quantity, direction) != direction for quantity, direction in other.changes)


def reconciled(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return findings without the advice that another finding's advice contradicts or that another one explains.

    Args:
        findings: Any, each with a name of `CAUSES`.
    """
    grave = {finding.name for finding in findings if finding.severity > Severity.NOTE}
    explained = {name for cause in grave for name in EXPLAINS.get(cause, ())}
    advised, silent = list[Finding](), set[int]()
    for finding in sorted(findings, key=_rank):
        if finding.name in explained or any(contradict(finding, other) for other in advised):
            silent.add(id(finding))
        else:
            advised.append(finding)
    return tuple(
        replace(one, advice="", options=(), changes=()) if id(one) in silent else one for one in findings
    )


def _rank(finding: Finding) -> tuple[int, int]:
    return -finding.severity, CAUSES.index(finding.name)


def event_of(finding: Finding) -> Found:
    """Return a finding as the event of a job, in the words of a page."""
    return Found(
        finding.name,
        finding.severity.name.lower(),
        plain_of(finding.sentence),
        plain_of(finding.advice),
        finding.images,
        finding.values,
        finding.options,
    )


def command(*words: str | Path) -> str:
    """Return a gsplat-edu command quoted for the shell, safe for any file name."""
    # a file name that begins with a dash would be parsed as an option
    spelled = [
        f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word) for word in words
    ]
    return shlex.join(["gsplat-edu", *spelled])


def new_run(name: str) -> Path:
    """Propose a new folder for a run: the first of out/NAME, out/NAME_2, ... that does not exist."""
    proposed, copy = Path("out") / name, 2
    while proposed.exists():
        proposed, copy = Path("out") / f"{name}_{copy}", copy + 1
    return proposed


def counted(number: int, word: str) -> str:
    """Return a number with its noun: 1 pair, 2 pairs."""
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def listed(names: Sequence[str]) -> str:
    """Name the first images of a list and count the others."""
    shown = ", ".join(names[:NAMED])
    return shown if len(names) <= NAMED else f"{shown} and {len(names) - NAMED} more"


def diagnosis_lines(diagnosis: Diagnosis) -> list[str]:
    """Return a diagnosis as lines of text, without its advice (see `advice_lines`)."""
    rows = [*diagnosis.facts]
    rows += finding_rows(diagnosis.ranked)
    if diagnosis.fine:
        rows.append(("fine", ", ".join(diagnosis.fine)))
    return table_lines(rows)


def finding_rows(findings: Iterable[Finding]) -> list[tuple[str, str]]:
    """Return a row for each finding: its severity, and its name, sentence and images."""
    return [(finding.severity.name.lower(), _described(finding)) for finding in findings]


def advice_lines(diagnosis: Diagnosis) -> list[str]:
    """Return the advice as numbered lines."""
    return ["what to do:", *(f"  {number}. {text}" for number, text in enumerate(diagnosis.advice, 1))]


def table_lines(rows: Iterable[tuple[str, str]]) -> list[str]:
    """Return (name, value) pairs as lines with the values aligned."""
    return [f"{name:<10} {value}".rstrip() for name, value in rows]


def _described(finding: Finding) -> str:
    images = f": {listed(finding.labels)}" if finding.images else ""
    return f"{finding.name}: {finding.sentence}{images}"

"""The doctor's diagnosis: all findings in their order, with advice that does not contradict itself."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from gsplat_edu.base.text import plain_of
from gsplat_edu.data.notes import Note
from gsplat_edu.jobs.events import Found
from gsplat_edu.survey.finding import Change, Finding, Severity, listed
from gsplat_edu.survey.order import CAUSES, CHECKS, EXPLAINS

ADVICE = 3
"""Number of pieces of advice at the end of a diagnosis; users do not follow more than three."""


class Advice(NamedTuple):
    """A piece of advice."""

    text: str
    """What to do."""
    changes: tuple[Change, ...] = ()
    """What it changes."""


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
        findings: Any.
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
    return -finding.severity, _place(CAUSES, finding.name)


def _place(names: Sequence[str], name: str) -> int:
    """Return the place of a name in an order; those of plug-ins come last."""
    return names.index(name) if name in names else len(names)


def in_order(
    checks: Iterable[tuple[str, Sequence[Finding]]],
) -> tuple[tuple[Finding, ...], tuple[str, ...]]:
    """Return the findings of checks in the order of `CHECKS`, and the names of the checks that found nothing.

    Args:
        checks: Name and findings of each; those of one name count as one check.
    """
    by_name: dict[str, list[Finding]] = {}
    for name, findings in sorted(checks, key=lambda check: _place(CHECKS, check[0])):
        by_name.setdefault(name, []).extend(findings)
    found = tuple(finding for findings in by_name.values() for finding in findings)
    return found, tuple(name for name, findings in by_name.items() if not findings)


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


def new_run(name: str) -> Path:
    """Propose a new folder for a run: the first of out/NAME, out/NAME_2, ... that does not exist."""
    proposed, copy = Path("out") / name, 2
    while proposed.exists():
        proposed, copy = Path("out") / f"{name}_{copy}", copy + 1
    return proposed


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

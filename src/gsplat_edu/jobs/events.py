"""Events that a command reports while it runs, as values; a file of events has one JSON object per line.

A command writes them if the variable `EVENTS` of its environment names a file (`gsplat_edu.jobs.emitter`). Every line
has `event`, the name of the kind, and `time`, seconds since 1970; the other fields are those of the class.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from gsplat_edu.base.json_fields import LARGEST_NUMBER
from gsplat_edu.base.reading import parse_json

EVENTS = "GSPLAT_EDU_EVENTS"
"""Environment variable that names the file of events."""


@dataclass(frozen=True)
class Started:
    """A process of the job began.

    Args:
        pid: Its process id.
        identity: `gsplat_edu.jobs.process.identity` of it; empty where the system has none.
    """

    pid: int
    identity: str


@dataclass(frozen=True)
class Stage:
    """A part of the work began: photos, features, training, evaluating, ...

    Args:
        name: The part.
    """

    name: str


@dataclass(frozen=True)
class Progress:
    """How far a stage is.

    Args:
        stage: The stage.
        done: Steps done.
        total: All steps; None if unknown.
        seconds_left: Forecast for the rest of the stage, s; None if unknown.
    """

    stage: str
    done: float
    total: float | None = None
    seconds_left: float | None = None


@dataclass(frozen=True)
class Message:
    """A line that the command prints.

    Args:
        text: The line.
    """

    text: str


@dataclass(frozen=True)
class Found:
    """A finding of the doctor (`gsplat_edu.doctor.finding.Finding`).

    Args:
        name: One or two words.
        severity: note, warning or fatal.
        sentence: The problem, with numbers.
        advice: What to do about it.
        images: Names of the affected photos.
        values: A measured value for each of these photos, as text; empty if there is none.
        options: Options of a training that the advice proposes, with their values.
    """

    name: str
    severity: str
    sentence: str
    advice: str
    images: tuple[str, ...] = ()
    values: tuple[str, ...] = ()
    options: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Diagnosed:
    """The rest of the doctor's diagnosis.

    Args:
        facts: (name, value) pairs that describe the capture or run.
        fine: Names of the checks that found nothing.
        advice: The most useful advice, most useful first.
    """

    facts: tuple[tuple[str, str], ...]
    fine: tuple[str, ...]
    advice: tuple[str, ...]


@dataclass(frozen=True)
class Metric:
    """A measured figure.

    Args:
        name: For example "psnr".
        value: The figure; None if it is not finite.
        unit: Its unit; empty for none.
        of: What was measured: "test", or an exported file.
    """

    name: str
    value: float | None
    unit: str = ""
    of: str = ""


@dataclass(frozen=True)
class Failed:
    """The command ended with an error.

    Args:
        line: The line that the command line prints.
        code: Exit code.
    """

    line: str
    code: int


@dataclass(frozen=True)
class Interrupted:
    """The command ended because the user or the queue interrupted it.

    Args:
        line: The line that the command line prints.
    """

    line: str


@dataclass(frozen=True)
class Finished:
    """The command ended well.

    Args:
        outputs: Files and folders that it wrote.
    """

    outputs: tuple[str, ...] = ()


Event = Started | Stage | Progress | Message | Found | Diagnosed | Metric | Failed | Interrupted | Finished

KINDS: dict[str, type[Event]] = {
    kind.__name__.lower(): kind
    for kind in (Started, Stage, Progress, Message, Found, Diagnosed, Metric, Failed, Interrupted, Finished)
}
"""The kinds by their names in files."""


def line_of(event: Event, time: float) -> str:
    """Return an event as a line of a file, with its line end.

    Args:
        event: The event.
        time: Seconds since 1970.
    """
    fields = {name: _finite(value) for name, value in dataclasses.asdict(event).items()}
    entry = {"event": type(event).__name__.lower(), "time": round(time, 3), **fields}
    return json.dumps(entry, allow_nan=False) + "\n"


def parse_line(line: str | bytes) -> tuple[float, Event]:
    """Parse a line of a file.

    Returns:
        Its time and the event.

    Raises:
        ValueError: the line is damaged, or of an unknown kind.
    """
    entry = parse_json(line)
    if not isinstance(entry, dict):
        raise ValueError("is not an event")
    kind, time = KINDS.get(str(entry.pop("event", None))), entry.pop("time", 0.0)
    if kind is None or not _is_number(time):
        raise ValueError("is not an event")
    known = {field.name: str(field.type) for field in dataclasses.fields(kind)}
    for name, value in entry.items():
        if name not in known or not TYPES[known[name]](value):
            raise ValueError(f"its field {name[:40]!r} is not known, or has an impossible value")
    try:
        return float(time), kind(**{name: _tuple(value) for name, value in entry.items()})
    except TypeError:
        raise ValueError("lacks a field") from None


def _is_number(value: Any) -> bool:  # noqa: ANN401
    return type(value) in (int, float) and abs(value) <= LARGEST_NUMBER  # not NaN either


def _is_texts(value: Any) -> bool:  # noqa: ANN401
    return isinstance(value, list) and all(isinstance(text, str) for text in value)


TYPES: Mapping[str, Callable[[Any], bool]] = {
    "int": lambda value: type(value) is int and abs(value) <= LARGEST_NUMBER,
    "float": _is_number,
    "float | None": lambda value: value is None or _is_number(value),
    "str": lambda value: isinstance(value, str),
    "tuple[str, ...]": _is_texts,
    "tuple[tuple[str, str], ...]": lambda value: (
        isinstance(value, list) and all(_is_texts(pair) and len(pair) == 2 for pair in value)
    ),
}
"""Checks of a field's value, by the field's type."""


def _tuple(value: Any) -> Any:  # noqa: ANN401
    return tuple(map(_tuple, value)) if isinstance(value, list) else value


def _finite(value: Any) -> Any:  # noqa: ANN401
    """Replace NaN and infinities by None, which JSON can represent."""
    return None if isinstance(value, float) and not math.isfinite(value) else value

"""Events that a command reports while it runs, as values; a file of events has one JSON object per line.

A command writes them if the variable `EVENTS` of its environment names a file (`gsplat_edu.jobs.emitter`). Every line
has `event`, the name of the kind, and `time`, seconds since 1970; the other fields are those of the class.
"""

from __future__ import annotations

import json
from typing import Annotated, TypeAlias

from msgspec import Meta, to_builtins

from gsplat_edu.base.reading import parse_json
from gsplat_edu.base.records import Number, Record, record_of, without_nan
from gsplat_edu.base.validation import LARGEST_WHOLE

Whole = Annotated[int, Meta(ge=-LARGEST_WHOLE, le=LARGEST_WHOLE)]

EVENTS = "GSPLAT_EDU_EVENTS"
"""Environment variable that names the file of events."""


class _Event(Record, frozen=True, tag_field="event", tag=str.lower):
    """Base of events; `event` is the name of the class in lower case."""


class Started(_Event, frozen=True):
    """A process of the job began.

    Args:
        pid: Its process id.
        identity: `gsplat_edu.jobs.process.identity` of it; empty where the system has none.
    """

    pid: Whole
    identity: str


class Stage(_Event, frozen=True):
    """A part of the work began: photos, features, training, evaluating, ...

    Args:
        name: The part.
    """

    name: str


class Progress(_Event, frozen=True):
    """How far a stage is.

    Args:
        stage: The stage.
        done: Steps done.
        total: All steps; None if unknown.
        seconds_left: Forecast for the rest of the stage, s; None if unknown.
    """

    stage: str
    done: Number
    total: Number | None = None
    seconds_left: Number | None = None


class Message(_Event, frozen=True):
    """A line that the command prints.

    Args:
        text: The line.
    """

    text: str


class Found(_Event, frozen=True):
    """A finding of the doctor (`gsplat_edu.survey.finding.Finding`).

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


class Diagnosed(_Event, frozen=True):
    """The rest of the doctor's diagnosis.

    Args:
        facts: (name, value) pairs that describe the capture or run.
        fine: Names of the checks that found nothing.
        advice: The most useful advice, most useful first.
    """

    facts: tuple[tuple[str, str], ...]
    fine: tuple[str, ...]
    advice: tuple[str, ...]


class Metric(_Event, frozen=True):
    """A measured figure.

    Args:
        name: For example "psnr".
        value: The figure; None if it is not finite.
        unit: Its unit; empty for none.
        of: What was measured: "test", or an exported file.
    """

    name: str
    value: Number | None
    unit: str = ""
    of: str = ""


class Failed(_Event, frozen=True):
    """The command ended with an error.

    Args:
        line: The line that the command line prints.
        code: Exit code.
    """

    line: str
    code: Whole


class Interrupted(_Event, frozen=True):
    """The command ended because the user or the queue interrupted it.

    Args:
        line: The line that the command line prints.
    """

    line: str


class Finished(_Event, frozen=True):
    """The command ended well.

    Args:
        outputs: Files and folders that it wrote.
    """

    outputs: tuple[str, ...] = ()


Event: TypeAlias = (
    Started | Stage | Progress | Message | Found | Diagnosed | Metric | Failed | Interrupted | Finished
)


class _Time(Record, frozen=True, forbid_unknown_fields=False):
    time: Number = 0.0


def line_of(event: Event, time: float) -> str:
    """Return an event as a line of a file, with its line end.

    Args:
        event: The event.
        time: Seconds since 1970.
    """
    entry = {"time": round(time, 3), **to_builtins(event)}
    return json.dumps(without_nan(entry), allow_nan=False) + "\n"


def parse_line(line: str | bytes) -> tuple[float, Event]:
    """Parse a line of a file.

    Returns:
        Its time and the event.

    Raises:
        ValueError: the line is damaged, or of an unknown kind.
    """
    entry = parse_json(line)
    time = record_of("", entry, _Time).time
    event: Event = record_of("", {name: entry[name] for name in entry if name != "time"}, Event)
    return time, event

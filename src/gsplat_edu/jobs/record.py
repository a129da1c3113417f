"""A job on disk: its work, its state, and the files of its output.

A record has no command line. Its work is validated, and its command line rendered, whenever the record is read and
again when the job starts: so a folder that somebody else made cannot name a program, a path or an address.

job.json        the record below
events.jsonl    its events (`gsplat_edu.jobs.events`), of all its attempts
output.txt      what it printed, of all its attempts
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, field, structs, to_builtins

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import open_file, parse_json
from gsplat_edu.base.records import Record, record_of
from gsplat_edu.base.text import printable, shortened

VERSION = 3

ID = re.compile(r"[0-9]{6}")
"""Ids of jobs: numbers in the order of their creation."""

MOST_BYTES = 1 << 20
"""Bytes of a record."""

LONGEST_LINE = 2_000
"""Characters of each text of a record."""

MOST_PLACES = 100
"""Inputs of a job, and outputs."""

LATEST = 1e11
"""Seconds since 1970 of the latest date that a record may have, in the year 5138."""

HIGHEST = 2**31 - 1
"""Highest process id and number of attempts."""


class State(StrEnum):
    """State of a job."""

    HELD = "held"
    """An earlier queue left it waiting; it starts only when somebody asks for it."""
    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    """Its processes are stopped; they keep their memory and the job keeps its place."""
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"
    """The user ended it."""
    INTERRUPTED = "interrupted"
    """It ended without a result because its process, the server or the computer did."""


ACTIVE = (State.RUNNING, State.PAUSED)
"""States with a process."""

RESUMABLE = (State.HELD, State.FAILED, State.CANCELLED, State.INTERRUPTED)
"""States from which a job can be started, or started again."""


class Purpose(StrEnum):
    """What a command line is rendered for."""

    SHOW = "show"
    """To show it; its places may be gone."""
    BEGIN = "begin"
    """To start it; its outputs must not exist."""
    CONTINUE = "continue"
    """To start it again; its outputs may exist in part."""


_Line = Annotated[str, Meta(max_length=LONGEST_LINE)]
_Time = Annotated[float, Meta(ge=0.0, le=LATEST)]
_Places = Annotated[tuple[_Line, ...], Meta(max_length=MOST_PLACES)]


class Work(Record, frozen=True):
    """What a job does.

    A place is a text with slashes. Two places are independent unless they are equal: a file below an entry counts as
    part of the entry only where the entry is renamed or asked whether it is in use.

    Args:
        command: Name of the command.
        inputs: Places that it reads.
        outputs: Places that it writes.
        options: Values of the command's options.
    """

    command: _Line
    inputs: _Places = ()
    outputs: _Places = ()
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def places(self) -> tuple[str, ...]:
        """All inputs and outputs."""
        return (*self.inputs, *self.outputs)

    def uses(self, place: str) -> bool:
        """Return whether a place, or one below it, is an input or an output."""
        return any(own == place or own.startswith(f"{place}/") for own in self.places)

    def renamed(self, old: str, new: str) -> Work:
        """Return the work after a place got another name; places below it move along."""
        return structs.replace(
            self,
            inputs=tuple(_renamed(own, old, new) for own in self.inputs),
            outputs=tuple(_renamed(own, old, new) for own in self.outputs),
        )


def _renamed(own: str, old: str, new: str) -> str:
    return new + own[len(old) :] if own == old or own.startswith(f"{old}/") else own


def collision(one: Work, other: Work, identify: Callable[[str], Hashable]) -> str | None:
    """Return a place that one of two jobs writes and the other one reads or writes; None if there is none.

    Args:
        one: Work of a job; the place is named as it names it.
        other: Work of another job.
        identify: Returns equal values for two names of the same place.
    """
    read, written = ({identify(place) for place in places} for places in (other.places, other.outputs))
    for place in one.places:
        if identify(place) in (read if place in one.outputs else written):
            return place
    return None


@dataclass(frozen=True)
class Rendered:
    """Work that is allowed, with its command line.

    Args:
        work: The work, with what rendering has decided.
        argv: Words after `gsplat-edu`.
    """

    work: Work
    argv: tuple[str, ...]


NOT_STORED = frozenset({"argv", "waits_for"})
"""Fields of a job that its record lacks."""

Render = Callable[[Work, Purpose], Rendered]
"""Validates a work and renders its command line; raises ArgumentError if it is not allowed."""


@dataclass(frozen=True)
class Job:
    """Work, its state and its processes.

    Args:
        id: Its name, that of its folder; later jobs have greater ones.
        work: What it does.
        argv: Its command line, words after `gsplat-edu`; rendered again when the job starts, and not in the record.
        state: Its state.
        created: When it was made, seconds since 1970.
        started: When its last attempt began; None before the first.
        ended: When it ended; None before.
        attempts: Number of processes that were started for it.
        pid: Process id of the last attempt; None if it is not known.
        identity: `gsplat_edu.jobs.process.identity` of that process.
        line: Why it failed or was interrupted, in one line.
        cancelled: Whether the user asked for its end.
        begun_by: Words of the proposal that began it and can be undone; empty for others, and once its result is kept.
        begun_at: Place for which that proposal was made.
        waits_for: Jobs that have to end before this one may start, and a place that both use; not in the record.
    """

    id: str
    work: Work
    argv: tuple[str, ...]
    state: State
    created: _Time
    started: _Time | None = None
    ended: _Time | None = None
    attempts: Annotated[int, Meta(ge=0, le=HIGHEST)] = 0
    pid: Annotated[int, Meta(ge=2, le=HIGHEST)] | None = (
        None  # 1 starts the system; 0 is the own process group
    )
    identity: _Line = ""
    line: _Line = ""
    cancelled: bool = False
    begun_by: _Line = ""
    begun_at: _Line = ""
    waits_for: tuple[tuple[str, str], ...] = ()

    @property
    def command(self) -> str:
        """The command line that repeats the job, quoted for the shell."""
        return shlex.join(["gsplat-edu", *self.argv])

    @property
    def resumable(self) -> bool:
        """Whether it can be started, or started again."""
        return self.state in RESUMABLE

    def document(self) -> dict[str, Any]:
        """Return the record as JSON has it: the work, and no command line."""
        facts = to_builtins(self)
        return {"version": VERSION, **{name: facts[name] for name in facts if name not in NOT_STORED}}


def one_line(text: str) -> str:
    """Return a text as one line of at most `LONGEST_LINE` characters."""
    return shortened(printable(text), LONGEST_LINE)


@dataclass(frozen=True)
class JobFolder:
    """The folder of a job.

    Args:
        path: The folder; its name is the job's id.
    """

    path: Path

    @property
    def record(self) -> Path:
        """The record."""
        return self.path / "job.json"

    @property
    def events(self) -> Path:
        """The events."""
        return self.path / "events.jsonl"

    @property
    def output(self) -> Path:
        """What the job printed."""
        return self.path / "output.txt"

    def write(self, job: Job) -> None:
        """Write the record; a reader sees the old one or the new one.

        Raises:
            OSError: it cannot be written; the old one is unchanged.
        """
        with written_aside(self.record) as aside:
            aside.write_text(json.dumps(job.document(), indent=1) + "\n", encoding="utf-8")

    def read(self, render: Render) -> Job:
        """Read the record.

        Args:
            render: Validates its work.

        Raises:
            ArgumentError: it is damaged, or its work is not allowed.
        """
        try:
            self._check_files()
            with open_file(self.record) as file:
                data = file.read(MOST_BYTES + 1)
            entry: Any = parse_json(data) if len(data) <= MOST_BYTES else None
            if not isinstance(entry, dict) or entry.pop("version", None) != VERSION:
                raise ValueError("it is no record of this version")
            if set(entry) != {own.name for own in fields(Job)} - NOT_STORED:
                raise ValueError("it has other fields")
            job: Job = record_of("", entry | {"argv": ()}, Job)
            if job.id != self.path.name:
                raise ValueError("it belongs to another job")
            texts = (job.work.command, *job.work.places, job.identity, job.line, job.begun_by, job.begun_at)
            if any(printable(text) != text for text in texts):
                raise ValueError("a text has characters that cannot be printed")
            shown = render(job.work, Purpose.SHOW)
        except OSError as error:
            raise ArgumentError(f"job {self.path.name}: is damaged ({error.strerror}); remove it") from None
        except ValueError as error:
            why = shortened(printable(str(error)))
            raise ArgumentError(f"job {self.path.name}: is damaged ({why}); remove it") from None
        return replace(job, work=shown.work, argv=shown.argv)

    def _check_files(self) -> None:
        """Check that the folder and its files are no links.

        Raises:
            ValueError: the folder, or a file in it, is a link or no file.
        """
        if self.path.is_symlink() or not self.path.is_dir():
            raise ValueError("it is a link or no folder")
        for path in (self.record, self.events, self.output):
            if path.is_symlink() or (path.exists() and not path.is_file()):
                raise ValueError(f"{path.name} is a link or no file")

"""A job on disk: what was asked for, its state, and the files of its output.

A record has no command line. Its request is validated again, and the command line made of it again, whenever the record
is read: a folder that somebody else made cannot name a program, a path or an address.

job.json        the record below
events.jsonl    its events (`gsplat_edu.jobs.events`), of all its attempts
output.txt      what it printed, of all its attempts
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import open_file, parse_json
from gsplat_edu.base.text import printable, shortened

VERSION = 2

ID = re.compile(r"[0-9]{6}")
"""Ids of jobs: numbers in the order of their creation."""

MOST_BYTES = 1 << 20
"""Bytes of a record."""

LONGEST_LINE = 2_000
"""Characters of a record's line and of each of its outputs and texts."""

MOST_OUTPUTS = 1_000
"""Outputs of a job."""

LATEST = 1e11
"""Seconds since 1970 of the latest date that a record may have, in the year 5138."""

HIGHEST = 2**31 - 1
"""Highest process id and number of attempts."""


class State(StrEnum):
    """Where a job stands."""

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
    """What a request is turned into a command line for."""

    SHOW = "show"
    """To show it; what it names may be gone."""
    BEGIN = "begin"
    """To start it; what it makes may not exist."""
    CONTINUE = "continue"
    """To start it again; what it makes may exist in part."""


@dataclass(frozen=True)
class Work:
    """A validated request and the command line made of it.

    Args:
        request: The request with everything that it had left open; the same request makes the same command line.
        argv: Words after `gsplat-edu`.
        title: A few words for people.
        subject: What it works on: "runs/toy", for example; empty for nothing in particular.
    """

    request: Mapping[str, Any]
    argv: tuple[str, ...]
    title: str = ""
    subject: str = ""


Rebuild = Callable[[Mapping[str, Any], Purpose], Work]
"""Validates a request and turns it into a command line; raises ArgumentError if it is not allowed."""


@dataclass(frozen=True)
class Job:
    """A command line and what became of it.

    Args:
        id: Its name, that of its folder; later jobs have greater ones.
        work: What it does.
        state: Where it stands.
        created: When it was made, seconds since 1970.
        started: When its last attempt began; None before the first.
        ended: When it ended; None before.
        attempts: Number of processes that were started for it.
        pid: Process id of the last attempt; None if it is not known.
        identity: `gsplat_edu.jobs.process.identity` of that process.
        line: Why it failed or was interrupted, in one line.
        outputs: Files and folders that it wrote.
        cancelled: Whether the user asked for its end.
    """

    id: str
    work: Work
    state: State
    created: float
    started: float | None = None
    ended: float | None = None
    attempts: int = 0
    pid: int | None = None
    identity: str = ""
    line: str = ""
    outputs: tuple[str, ...] = ()
    cancelled: bool = False

    @property
    def argv(self) -> tuple[str, ...]:
        """Words after `gsplat-edu`."""
        return self.work.argv

    @property
    def title(self) -> str:
        """A few words for people."""
        return self.work.title

    @property
    def subject(self) -> str:
        """What it works on."""
        return self.work.subject

    @property
    def command(self) -> str:
        """The command line that repeats the job, quoted for the shell."""
        return shlex.join(["gsplat-edu", *self.argv])

    @property
    def resumable(self) -> bool:
        """Whether it can be started, or started again."""
        return self.state in RESUMABLE

    def document(self) -> dict[str, Any]:
        """Return the record as JSON has it: the request, and no command line."""
        facts = {name: getattr(self, name) for name in RECORD_FIELDS}
        return {"version": VERSION, "id": self.id, "request": dict(self.work.request), **facts}


def _text(value: Any) -> bool:  # noqa: ANN401
    return isinstance(value, str) and len(value) <= LONGEST_LINE and printable(value) == value


def _time(value: Any) -> bool:  # noqa: ANN401
    return type(value) in (int, float) and 0 <= value <= LATEST


def _whole(least: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and least <= value <= HIGHEST


def _or_none(check: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or check(value)


RECORD_FIELDS: Mapping[str, Callable[[Any], bool]] = {
    "state": lambda value: isinstance(value, str) and value in tuple(State),
    "created": _time,
    "started": _or_none(_time),
    "ended": _or_none(_time),
    "attempts": _whole(0),
    "pid": _or_none(_whole(2)),  # 1 starts the system, and 0 means the own process group
    "identity": _text,
    "line": _text,
    "outputs": lambda value: (
        isinstance(value, list | tuple) and len(value) <= MOST_OUTPUTS and all(map(_text, value))
    ),
    "cancelled": lambda value: isinstance(value, bool),
}
"""The other fields of a record, and what each may hold."""


def one_line(text: str) -> str:
    """Return a text as a record may have it."""
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

    def read(self, rebuild: Rebuild) -> Job:
        """Read the record.

        Args:
            rebuild: Turns its request into a command line.

        Raises:
            ArgumentError: it is damaged, or asks for what is not allowed.
        """
        try:
            self._check_files()
            with open_file(self.record) as file:
                data = file.read(MOST_BYTES + 1)
            entry = parse_json(data) if len(data) <= MOST_BYTES else None
            if not isinstance(entry, dict) or entry.get("version") != VERSION:
                raise ValueError("it is no record of this version")
            if set(entry) != {"version", "id", "request", *RECORD_FIELDS}:
                raise ValueError("it has other fields")
            if entry["id"] != self.path.name:
                raise ValueError("it belongs to another job")
            for name, is_allowed in RECORD_FIELDS.items():
                if not is_allowed(entry[name]):
                    raise ValueError(f"{name} has an impossible value")
            if not isinstance(entry["request"], dict):
                raise ValueError("it has no request")
            work = rebuild(entry["request"], Purpose.SHOW)
        except OSError as error:
            raise ArgumentError(f"job {self.path.name}: is damaged ({error.strerror}); remove it") from None
        except ValueError as error:
            why = shortened(printable(str(error)))
            raise ArgumentError(f"job {self.path.name}: is damaged ({why}); remove it") from None
        facts = {name: entry[name] for name in RECORD_FIELDS}
        facts |= {"state": State(entry["state"]), "outputs": tuple(entry["outputs"])}
        return Job(self.path.name, work, **facts)

    def _check_files(self) -> None:
        """Check that nothing here leads elsewhere.

        Raises:
            ValueError: the folder, or a file in it, is a link or no file.
        """
        if self.path.is_symlink() or not self.path.is_dir():
            raise ValueError("it is a link or no folder")
        for path in (self.record, self.events, self.output):
            if path.is_symlink() or (path.exists() and not path.is_file()):
                raise ValueError(f"{path.name} is a link or no file")

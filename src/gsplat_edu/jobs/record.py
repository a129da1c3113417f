"""A job on disk: a command line, its state, and the files of its output.

job.json        the record below
events.jsonl    its events (`gsplat_edu.jobs.events`), of all its attempts
output.txt      what it printed, of all its attempts
"""

from __future__ import annotations

import dataclasses
import json
import shlex
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from gsplat_edu.errors import ArgumentError
from gsplat_edu.files import written_aside
from gsplat_edu.reading import parse_json, read_bytes

VERSION = 1


class State(StrEnum):
    """Where a job stands."""

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

RESUMABLE = (State.FAILED, State.CANCELLED, State.INTERRUPTED)
"""States from which a job can be started again."""


@dataclass(frozen=True)
class Job:
    """A command line and what became of it.

    Args:
        id: Its name, that of its folder; later jobs have greater ones.
        argv: Words after `gsplat-edu`.
        state: Where it stands.
        created: When it was made, seconds since 1970.
        title: A few words for people.
        subject: What it works on: "runs/toy", for example; empty for nothing in particular.
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
    argv: tuple[str, ...]
    state: State
    created: float
    title: str = ""
    subject: str = ""
    started: float | None = None
    ended: float | None = None
    attempts: int = 0
    pid: int | None = None
    identity: str = ""
    line: str = ""
    outputs: tuple[str, ...] = ()
    cancelled: bool = False

    @property
    def command(self) -> str:
        """The command line that repeats the job, quoted for the shell."""
        return shlex.join(["gsplat-edu", *self.argv])

    @property
    def resumable(self) -> bool:
        """Whether it can be started again."""
        return self.state in RESUMABLE

    def again(self) -> tuple[str, ...]:
        """Return the words that continue it; other commands than `train` resume by themselves or begin again."""
        return resumed(self.argv)

    def document(self) -> dict[str, Any]:
        """Return the record as JSON has it."""
        return {"version": VERSION, **dataclasses.asdict(self)}


def resumed(argv: tuple[str, ...]) -> tuple[str, ...]:
    """Return the words that continue a command where it ended."""
    if argv[:1] != ("train",) or "--resume" in argv or "--out" not in argv[:-1]:
        return argv
    run = Path(argv[argv.index("--out") + 1])
    return (*argv, "--resume") if (run / "config.json").is_file() else argv


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

    def read(self) -> Job:
        """Read the record.

        Raises:
            ArgumentError: it is damaged.
            OSError: it cannot be read.
        """
        try:
            entry = parse_json(read_bytes(self.record))
            if entry.pop("version") != VERSION:
                raise ValueError("is of another version")
            entry["state"] = State(entry["state"])
            for name in ("argv", "outputs"):
                entry[name] = tuple(map(str, entry[name]))
            job = Job(**entry)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ArgumentError(f"{self.record}: is damaged ({error}); remove its folder") from None
        if job.id != self.path.name:
            raise ArgumentError(f"{self.record}: is of job {job.id!r}; remove its folder")
        return job

"""Write a command's events, if it runs as a job.

The printing layer of the command line calls `emit` for every line and every step of a progress bar.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from gsplat_edu.jobs.events import EVENTS, Event, Finished, Progress, Stage, Started, line_of
from gsplat_edu.jobs.process import identity

PROGRESS_SECONDS = 0.5
"""Seconds between two progress events of one stage; the last one is always written."""


class Emitter:
    """Appends events to a file, one write per line, so that a reader never sees parts of two.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._file: int | None = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        self._stage, self._last = "", 0.0
        self._outputs: list[str] = []

    def emit(self, event: Event) -> None:
        """Write an event. If that fails, report it once and stop writing: a full disk must not end a training."""
        if self._file is None:
            return
        try:
            os.write(self._file, line_of(event, time.time()).encode())
        except OSError as error:
            print(f"the job's events cannot be written any more ({error.strerror})", file=sys.stderr)
            os.close(self._file)
            self._file = None

    def progress(
        self, stage: str, done: float, total: float | None, seconds_left: Callable[[], float | None]
    ) -> None:
        """Write the progress of a stage, and its start if it is new, at most every `PROGRESS_SECONDS`."""
        now = time.monotonic()
        if stage != self._stage:
            self._stage, self._last = stage, 0.0
            self.emit(Stage(stage))
        if now - self._last < PROGRESS_SECONDS and done != total:
            return
        self._last = now
        self.emit(Progress(stage, done, total, seconds_left()))

    def output(self, path: Path) -> None:
        """Note a file or folder that the command wrote, for its last event."""
        self._outputs.append(str(path))

    def finish(self) -> None:
        """Write the last event of a command that ended well."""
        self.emit(Finished(tuple(dict.fromkeys(self._outputs))))


_emitter: Emitter | None = None


def start_reporting() -> None:
    """Begin to write events if this process is a job. Its child processes are not jobs."""
    global _emitter  # noqa: PLW0603 - a process has one file of events
    path = os.environ.pop(EVENTS, "")
    if not path:
        return
    # a server in the background of a shell ignores SIGINT, and its jobs inherit this setting
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _emitter = Emitter(Path(path))
    emit(Started(os.getpid(), identity(os.getpid()) or ""))


def emit(event: Event) -> None:
    """Write an event if this process is a job."""
    if _emitter is not None:
        _emitter.emit(event)


def progress(
    stage: str, done: float, total: float | None, seconds_left: Callable[[], float | None] = lambda: None
) -> None:
    """Write the progress of a stage if this process is a job; only then is the forecast computed."""
    if _emitter is not None:
        _emitter.progress(stage, done, total, seconds_left)


def report_output(path: Path) -> None:
    """Note a file or folder that the command wrote, if this process is a job."""
    if _emitter is not None:
        _emitter.output(path)


def finish() -> None:
    """Write that the command ended well, if this process is a job."""
    if _emitter is not None:
        _emitter.finish()

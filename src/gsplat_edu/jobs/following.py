"""Read files of events while they grow."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from gsplat_edu.base.reading import open_file
from gsplat_edu.jobs.events import Event, Failed, Finished, Interrupted, Progress, Stage, Started, parse_line

PIECE = 1 << 20
"""Most bytes to read at once."""

LAST = 4096
"""Number of bytes at the end of a file that are searched for its last events; `PIECE` if they contain no whole
event."""

LONGEST_LINE = 8 << 20
"""Bytes of a line; a longer one is damaged."""

MOST_READ = 256 << 20
"""Bytes of a file of events that are read: a day's training writes a few MB."""


@dataclass
class Follower:
    """Reads the complete lines of a file that were not read before.

    Args:
        path: The file; it need not exist yet.
        offset: Bytes that were read.
        number: Lines that were read.
        rest: Begin of a line whose end is not there yet.
    """

    path: Path
    offset: int = 0
    number: int = 0
    rest: bytes = field(default=b"", repr=False)

    def read(self) -> list[tuple[int, float, Event]]:
        """Return the number of each new line, counted from 1, its time and its event; damaged lines only count."""
        found = []
        for line in self.lines():
            self.number += 1
            try:
                found.append((self.number, *parse_line(line)))
            except ValueError:
                continue
        return found

    def lines(self) -> list[bytes]:
        """Return the new complete lines as bytes."""
        try:
            with open_file(self.path) as file:
                file.seek(self.offset)
                data = file.read(PIECE)
        except OSError:
            return []
        self.offset += len(data)
        first, *others = data.split(b"\n")
        if len(self.rest) <= LONGEST_LINE:  # otherwise the line is too long; skip to its end
            self.rest += first
        if not others:
            return []
        *lines, rest = self.rest, *others
        self.rest = rest
        return lines


def events_after(path: Path, number: int = 0) -> list[tuple[int, float, Event]]:
    """Read a whole file of events.

    Args:
        path: The file.
        number: Leave out this many lines at the start.

    Returns:
        The number of each line, counted from 1, its time and its event.
    """
    follower, found = Follower(path), []
    try:
        size = min(path.stat().st_size, MOST_READ) if path.is_file() else 0
    except FileNotFoundError:  # its job has just been removed
        size = 0
    while follower.offset < size:
        before = follower.offset
        found += [entry for entry in follower.read() if entry[0] > number]
        if follower.offset == before:
            break
    return found


def has_started(path: Path, begin: int = 0) -> bool:
    """Return whether a process has reported its start.

    Args:
        path: The file.
        begin: Its size in bytes when the process was started; a start is the first event of every process.
    """
    try:
        with open_file(path) as file:
            file.seek(begin)
            first, end, _ = file.read(LAST).partition(b"\n")
        return bool(end) and isinstance(parse_line(first)[1], Started)
    except (OSError, ValueError):
        return False


def last_word(path: Path, begin: int = 0) -> Failed | Interrupted | Finished | None:
    """Return how the last process that wrote a file of events ended; None if the file does not tell.

    Args:
        path: The file.
        begin: Its size in bytes when that process was started, which may have ended before it wrote anything.
    """
    try:
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(max(size - LAST, begin))
            data = file.read()
            if size > LAST and data.count(b"\n") < 2:
                file.seek(max(size - PIECE, begin))
                data = file.read()
    except OSError:
        return None
    for line in reversed(data.splitlines()):
        try:
            event = parse_line(line)[1]
        except ValueError:
            continue
        if isinstance(event, Failed | Interrupted | Finished):
            return event
        if isinstance(event, Started):
            return None
    return None


def last_stage(path: Path) -> str:
    """Return the last stage in a file of events; empty if there is none."""
    try:
        with open_file(path) as file:
            file.seek(max(os.fstat(file.fileno()).st_size - LAST, 0))
            data = file.read()
    except OSError:
        return ""
    for line in reversed(data.splitlines()):
        try:
            event = parse_line(line)[1]
        except ValueError:
            continue
        if isinstance(event, Progress | Stage):
            return event.stage if isinstance(event, Progress) else event.name
    return ""


def last_start(path: Path) -> Started | None:
    """Return the last process that wrote a file of events; None if none has."""
    starts = [event for _, _, event in events_after(path) if isinstance(event, Started)]
    return starts[-1] if starts else None

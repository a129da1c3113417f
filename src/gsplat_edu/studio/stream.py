"""The events of all jobs as one stream (Server-Sent Events), which a browser resumes by itself after a break."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import secrets
import threading
from collections import deque
from collections.abc import AsyncIterator
from time import monotonic
from typing import Any

from msgspec import to_builtins

from gsplat_edu.base.locks import POLL
from gsplat_edu.base.text import whole_of
from gsplat_edu.jobs.events import Event
from gsplat_edu.jobs.following import Follower
from gsplat_edu.jobs.queue import JobQueue
from gsplat_edu.jobs.record import ACTIVE, Job
from gsplat_edu.studio.commands import subject_of, title_of
from gsplat_edu.studio.spoken import spoken

KEPT = 4_000
"""Number of events that are kept for browsers that missed them. A browser that missed more reads the list of jobs
again."""

HEARTBEAT = 15.0
"""Seconds of silence after which a comment is sent, to detect closed connections."""

LIBRARY_EVERY = 1.0
"""Least time between two events about changes of the library, s: uploads change it with every file."""

MOST_WATCHING = 64
"""Streams at once."""


def job_document(job: Job) -> dict[str, Any]:
    """Return a job as the API shows it."""
    return {
        "id": job.id,
        "title": title_of(job.work),
        "subject": subject_of(job.work),
        "work": to_builtins(job.work),
        "state": job.state.value,
        "command": job.command,
        "argv": list(job.argv),
        "created": job.created,
        "started": job.started,
        "ended": job.ended,
        "attempts": job.attempts,
        "line": job.line,
        "plain": spoken(job.line) if job.line else "",
        "waits_for": [{"job": name, "place": place} for name, place in job.waits_for],
        "resumable": job.resumable,
        "begun_by": job.begun_by,
        "begun_at": job.begun_at,
        "cancelling": job.cancelled and job.state in ACTIVE,
    }


def event_document(number: int, time: float, event: Event) -> dict[str, Any]:
    """Return an event of a job as the API shows it."""
    return {
        "number": number,
        "time": time,
        **to_builtins(event),
    }


class Stream:
    """Collects events of jobs and sends them to all watchers.

    Ids are `BOOT-NUMBER`. If a watcher's last id is too old or from an earlier start of the server, it gets the event
    `reset` and reads the list of jobs again.
    """

    def __init__(self) -> None:
        self.boot = secrets.token_hex(4)
        self._lock = threading.Lock()
        self._kept: deque[tuple[int, str]] = deque(maxlen=KEPT)
        self._number = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._woken: set[asyncio.Event] = set()
        self._followers: dict[str, Follower] = {}
        self._begun = set[str]()  # jobs that ran since the last look; one may end before the next
        self._over = threading.Event()
        self._library_changed = threading.Event()
        self._told = -math.inf  # when the stream last said so

    def close(self) -> None:
        """End all streams, for the end of the server; called in its event loop."""
        self._over.set()
        self._wake()

    def changed(self, name: str, job: Job | None) -> None:
        """Note a new state of a job, or that it was removed. May be called from any thread."""
        if job is None:
            self.publish("removed", {"id": name})
        else:
            if job.state in ACTIVE:
                with self._lock:
                    self._begun.add(name)
            self.publish("job", job_document(job))

    def library_changed(self) -> None:
        """Note that entries of the library have changed. May be called from any thread, for each file of many."""
        self._library_changed.set()

    def publish(self, kind: str, data: dict[str, Any]) -> None:
        """Add an event to the stream. May be called from any thread."""
        with self._lock:
            self._number += 1
            text = f"id: {self.boot}-{self._number}\nevent: {kind}\ndata: {json.dumps(data)}\n\n"
            self._kept.append((self._number, text))
            loop = self._loop
        if loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for woken in self._woken:
            woken.set()

    async def follow(self, queue: JobQueue) -> None:
        """Read the events of running jobs until cancelled."""
        self._loop = asyncio.get_running_loop()
        while True:
            await asyncio.to_thread(self.look, queue)
            await asyncio.sleep(POLL)

    def look(self, queue: JobQueue) -> None:
        """Publish what running jobs have written since the last look, and whether the library has changed."""
        if self._library_changed.is_set() and monotonic() - self._told >= LIBRARY_EVERY:
            self._library_changed.clear()
            self._told = monotonic()
            self.publish("library", {})
        jobs = {job.id: job for job in queue.jobs()}
        with self._lock:
            begun, self._begun = self._begun, set()
        for name in list(self._followers):
            if name not in jobs:
                del self._followers[name]
        for name, job in jobs.items():
            if job.state not in ACTIVE and name not in self._followers and name not in begun:
                continue
            follower = self._followers.get(name)
            if follower is None:
                follower = self._followers[name] = Follower(queue.folder / name / "events.jsonl")
            before = -1
            while before < follower.offset:  # a read ends after `PIECE` bytes
                before = follower.offset
                for number, time, event in follower.read():
                    self.publish("event", {"job": name, **event_document(number, time, event)})
            if job.state not in ACTIVE:
                self._followers.pop(name, None)

    async def watch(self, last_id: str | None) -> AsyncIterator[str]:
        """Yield the events after an id, if it is still known."""
        woken = asyncio.Event()
        if len(self._woken) >= MOST_WATCHING:
            yield "event: full\ndata: {}\n\n"
            return
        self._woken.add(woken)
        try:
            after = self._after(last_id)
            if after is None:
                with self._lock:
                    after = self._number
                yield f"id: {self.boot}-{after}\nevent: reset\ndata: {json.dumps({'boot': self.boot})}\n\n"
            while not self._over.is_set():
                woken.clear()
                with self._lock:
                    oldest = self._kept[0][0] if self._kept else self._number + 1
                    new = [entry for entry in self._kept if entry[0] > after]
                if oldest > after + 1 and new:  # the watcher was slower than the ring
                    yield "event: reset\ndata: {}\n\n"
                for number, text in new:
                    after = number
                    yield text
                if self._over.is_set():
                    break
                try:
                    await asyncio.wait_for(woken.wait(), HEARTBEAT)
                except TimeoutError:
                    yield ": still here\n\n"
        finally:
            self._woken.discard(woken)

    def _after(self, last_id: str | None) -> int | None:
        """Return the number of the last event that a watcher has; None if it has to start anew."""
        boot, _, text = (last_id or "").partition("-")
        number = whole_of(text)
        if boot != self.boot or number is None:
            return None
        with self._lock:
            oldest = self._kept[0][0] if self._kept else self._number + 1
            return number if oldest - 1 <= number <= self._number else None

"""A queue of jobs on disk. It starts jobs in order, follows their processes, and survives a restart.

A job that writes a place never runs beside one that reads or writes it. Each job waits for running jobs and earlier
queued jobs whose places collide with its own. So jobs of one place keep their order, readers cannot starve a writer,
and no two jobs wait for each other.

A thread looks at the processes several times a second. Nothing here waits for one: a cancelled job gets its signals in
turn, and the end of every process is read from what it wrote, or else from its exit code.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import described, remove_leftovers
from gsplat_edu.base.locks import POLL
from gsplat_edu.jobs.events import EVENTS, Failed, Finished, Interrupted
from gsplat_edu.jobs.following import LAST, has_started, last_start, last_word
from gsplat_edu.jobs.process import SIGNALS, carries, identity, is_running, send
from gsplat_edu.jobs.record import (
    ACTIVE,
    ID,
    Job,
    JobFolder,
    Purpose,
    Render,
    State,
    Work,
    collision,
    one_line,
)

PATIENCE = {"interrupt": 60.0, "terminate": 10.0}
"""Seconds after a signal of a cancellation until the next one: a checkpoint of millions of Gaussians takes a while."""

MOST_QUEUED = 200
"""Largest number of waiting jobs, against runaway programs."""

PROGRAM = (sys.executable, "-m", "gsplat_edu")
"""What runs a command line."""


Removed = TypeVar("Removed")


def _delete(path: Path) -> Any:  # noqa: ANN401
    """Delete the folder of a job; that of a damaged one may be a file or a link."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path)


class JobQueue:
    """The jobs of a folder.

    It may be used from any thread. Only one process may have a queue for a folder (see `gsplat_edu.base.locks`).

    Args:
        folder: One folder per job; created if missing.
        render: Validates what a job does and renders its command line; see `Render`.
        at_once: Most jobs that run at the same time.
        changed: Called with every new state of a job, from any thread and while the queue is locked; with None for a
            job that was removed.
        patience: See `PATIENCE`.
        hold: Called to pause a job (true) or continue it; returns whether the job pauses by itself. Otherwise its
            processes are stopped.
        program: What runs a command line.
        identify: Returns equal values for two names of the same place.
    """

    def __init__(
        self,
        folder: Path,
        render: Render,
        at_once: int = 1,
        changed: Callable[[str, Job | None], None] = lambda name, job: None,
        patience: dict[str, float] | None = None,
        hold: Callable[[Job, bool], bool] = lambda job, wait: False,
        program: Sequence[str] = PROGRAM,
        identify: Callable[[str], Hashable] = str,
    ) -> None:
        self.folder, self.at_once = folder, at_once
        self.changed, self.hold = changed, hold
        self.damaged: dict[str, str] = {}
        """By id, a line for each record that is unreadable or asks for something that is not allowed."""
        self.trouble = ""
        """Why records cannot be written; empty if they can."""
        self._render, self._program, self._identify = render, tuple(program), identify
        self._patience = PATIENCE if patience is None else patience
        self._lock = threading.RLock()
        self._jobs: dict[str, Job] = {}
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._endings: dict[str, tuple[str, float]] = {}  # the last signal of each cancellation, and when
        self._heard: dict[str, int] = {}  # size of each job's events when its process was started
        self._turns: dict[str, int] = {}  # when each job was queued, counted from 1
        self._latest = 0  # the highest id that a job of this queue has, or had
        self._settled: object = None  # the states that `_start_waiting` saw last
        self._closed = threading.Event()
        folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder)
        self._recover()
        self._thread = threading.Thread(target=self._watch, name="jobs", daemon=True)
        self._thread.start()

    def jobs(self) -> list[Job]:
        """Return all jobs, oldest first."""
        with self._lock:
            return [self._jobs[name] for name in sorted(self._jobs)]

    def get(self, name: str) -> Job:
        """Return a job.

        Raises:
            ArgumentError: there is none of this id.
        """
        with self._lock:
            if name not in self._jobs:
                raise ArgumentError(f"job {name!r}: does not exist; it may have been removed")
            return self._jobs[name]

    def files(self, name: str) -> JobFolder:
        """Return the folder of a job; errors as for `get`."""
        return JobFolder(self.folder / self.get(name).id)

    def submit(self, work: Work, begun_by: str = "", begun_at: str = "") -> Job:
        """Add a job to the end of the queue.

        Args:
            work: What it does.
            begun_by: See `Job`.
            begun_at: See `Job`.

        Raises:
            ArgumentError: it is not allowed, or too many jobs are waiting.
            OSError: its record cannot be written; there is then no job.
        """
        with self._lock:
            waiting = sum(job.state is State.QUEUED for job in self._jobs.values())
            if waiting >= MOST_QUEUED:
                raise ArgumentError(f"jobs: {waiting} are waiting; cancel some, or wait until they are done")
            known = [int(name) for name in os.listdir(self.folder) if ID.fullmatch(name)]  # noqa: PTH208
            self._latest = max([self._latest, *known]) + 1
            name = f"{self._latest:06d}"
            rendered = self._render(work, Purpose.BEGIN)
            facts = (name, rendered.work, rendered.argv, State.QUEUED, time.time())
            job = Job(*facts, begun_by=begun_by, begun_at=begun_at)
            folder = JobFolder(self.folder / name)
            folder.path.mkdir()
            try:
                folder.write(job)
            except BaseException:
                shutil.rmtree(folder.path, ignore_errors=True)
                raise
            self._note(job)
            return job

    def cancel(self, name: str) -> Job:
        """End a job: at once if it waits, else by an interruption, upon which a training writes a checkpoint.

        Raises:
            ArgumentError: there is none of this id, or it has ended.
        """
        with self._lock:
            job = self.get(name)
            if job.state in (State.QUEUED, State.HELD):
                return self._put(job, state=State.CANCELLED, ended=time.time(), cancelled=True)
            if job.state not in ACTIVE:
                raise ArgumentError(
                    f"job {name}: is {job.state}; only jobs that wait or run can be cancelled"
                )
            if job.state is State.PAUSED:
                self.hold(job, False)
            job = self._put(job, cancelled=True, state=State.RUNNING)
            self._end(job)
            return self._jobs[name]

    def pause(self, name: str) -> Job:
        """Stop the processes of a job until `resume`; they keep their memory.

        Raises:
            ArgumentError: there is none of this id, it does not run, or it is being cancelled.
        """
        with self._lock:
            job = self.get(name)
            if job.state is not State.RUNNING or name in self._endings:
                raise ArgumentError(f"job {name}: is {job.state}; only a running job can be paused")
            if job.pid is None or not is_running(job.pid, job.identity):
                raise ArgumentError(f"job {name}: has just ended")
            if not self.hold(job, True):
                send(job.pid, job.identity, signal.SIGSTOP, group=True)
            return self._put(job, state=State.PAUSED)

    def resume(self, name: str) -> Job:
        """Continue a paused job, or put one that was held or ended without a result at the end of the queue.

        Raises:
            ArgumentError: there is none of this id, it is waiting, running or done, or it is not allowed any more.
        """
        with self._lock:
            job = self.get(name)
            if job.state is State.PAUSED:
                self.hold(job, False)
                if job.pid is not None:
                    send(job.pid, job.identity, signal.SIGCONT, group=True)
                return self._put(job, state=State.RUNNING)
            if not job.resumable:
                raise ArgumentError(f"job {name}: is {job.state}; it cannot be resumed")
            job = self._rendered(job)
            job = replace(job, ended=None, line="", cancelled=False, pid=None, identity="")
            return self._put(job, state=State.QUEUED)

    def keep(self, name: str) -> Job:
        """Note that the result of a job is kept; nothing offers to undo it any more.

        Raises:
            ArgumentError: there is none of this id.
            OSError: its record cannot be written.
        """
        with self._lock:
            return self._put(self.get(name), begun_by="", begun_at="")

    def remove(self, name: str, away: Callable[[Path], Removed] = _delete) -> Removed:
        """Forget a job that waits or has ended or is damaged; what it wrote elsewhere stays.

        Args:
            name: Its id. No later job of this queue gets it.
            away: Takes its folder away; deletes it by default. What it returns is returned.

        Raises:
            ArgumentError: there is none of this id, or it is running.
            OSError: its folder cannot be removed.
        """
        with self._lock:
            if name not in self.damaged and self.get(name).state in ACTIVE:
                raise ArgumentError(f"job {name}: is {self.get(name).state}; cancel it first")
            self._latest = max(self._latest, int(name))
            removed = away(self.folder / name)
            self._jobs.pop(name, None)
            self.damaged.pop(name, None)
            self.changed(name, None)
            return removed

    def put_back(self, name: str) -> None:
        """Know a job again whose folder was put back after `remove`; one that waited is held."""
        with self._lock:
            self._read(self.folder / name)
            if name in self._jobs:
                self.changed(name, self._jobs[name])

    def rename(self, old: str, new: str, move: Callable[[], object]) -> None:
        """Rename a place, and use its new name in all jobs.

        Args:
            old: The place.
            new: Its new name.
            move: Renames the folder; no job starts meanwhile. If it fails, the jobs are unchanged.

        Raises:
            OSError: a record cannot be written.
        """
        with self._lock:
            move()
            for job in self.jobs():
                work = job.work.renamed(old, new)
                begun_at = new if job.begun_at == old else job.begun_at
                if work != job.work or begun_at != job.begun_at:
                    self._put(job, work=work, argv=self._render(work, Purpose.SHOW).argv, begun_at=begun_at)

    def close(self, interrupt: bool = True) -> None:
        """End the queue; waiting jobs stay waiting for the next queue.

        Args:
            interrupt: Whether running jobs are interrupted, which makes a training write a checkpoint; else they
                run on, and the next queue finds them.
        """
        self._closed.set()
        self._thread.join()
        with self._lock:
            active = [job for job in self._jobs.values() if job.state in ACTIVE]
            for job in active if interrupt else ():
                self._end(job)
        while interrupt and any(job.state in ACTIVE for job in self.jobs()):
            self._look()
            time.sleep(POLL)

    def _watch(self) -> None:
        while not self._closed.wait(POLL):
            try:
                self._look()
                self._start_waiting()
                self.trouble = ""
            except OSError as error:  # a record cannot be written: the next look tries again
                self.trouble = described(error)

    def _start_waiting(self) -> None:
        """Start waiting jobs up to `at_once`, unless their places collide with places of earlier jobs."""
        with self._lock:
            waiting = [job for job in self.jobs() if job.state is State.QUEUED]
            first = [job for job in self.jobs() if job.state in ACTIVE]
            states = [
                self.at_once,
                *((job.id, job.state, self._turns.get(job.id)) for job in (*first, *waiting)),
            ]
            if states == self._settled:
                return
            room, started = self.at_once - len(first), False
            for job in sorted(waiting, key=lambda job: self._turns[job.id]):
                before = [(other.id, collision(job.work, other.work, self._identify)) for other in first]
                waits_for = tuple((name, place) for name, place in before if place is not None)
                if waits_for != job.waits_for:
                    self._note(replace(job, waits_for=waits_for))
                if room > 0 and not waits_for:
                    self._start(self._jobs[job.id])
                    room, started = room - 1, True
                first.append(job)
            # A started job may end and be put back with the same turn before the next look.
            self._settled = None if started else states

    def _look(self) -> None:
        """Note which processes have ended, and send the next signal of cancellations."""
        with self._lock:
            for job in self.jobs():
                if job.state not in ACTIVE:
                    continue
                child = self._children.get(job.id)
                code = None if child is None else child.poll()
                if code is None and (child is not None or (job.pid and is_running(job.pid, job.identity))):
                    self._press(job)
                else:
                    self._ended(job, code)

    def _rendered(self, job: Job) -> Job:
        """Return a job with the command line that its next attempt runs.

        Raises:
            ArgumentError: its work is not allowed any more.
        """
        rendered = self._render(job.work, Purpose.CONTINUE if job.attempts else Purpose.BEGIN)
        return replace(job, work=rendered.work, argv=rendered.argv)

    def _start(self, job: Job) -> None:
        folder = JobFolder(self.folder / job.id)
        try:
            job = self._rendered(job)
        except ArgumentError as error:
            self._put(job, state=State.FAILED, ended=time.time(), line=one_line(str(error)))
            return
        job = self._put(job, state=State.RUNNING, started=time.time(), attempts=job.attempts + 1, pid=None)
        self._heard[job.id] = folder.events.stat().st_size if folder.events.exists() else 0
        try:
            with folder.output.open("ab") as output:
                child = subprocess.Popen(
                    [*self._program, *job.argv],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, EVENTS: _marker(folder), "PYTHONUNBUFFERED": "1"},
                    start_new_session=True,  # Ctrl-C in the server's terminal does not reach it
                )
        except OSError as error:
            self._put(job, state=State.FAILED, ended=time.time(), line=one_line(described(error)))
            return
        self._children[job.id] = child
        self._note(
            replace(job, pid=child.pid, identity=identity(child.pid) or "")
        )  # even if the disk is full
        folder.write(self._jobs[job.id])

    def _end(self, job: Job) -> None:
        """Send the first signal of a cancellation, unless it was sent."""
        if job.id not in self._endings:
            self._signal(job, "interrupt")

    def _press(self, job: Job) -> None:
        """Send the next signal of a cancellation if its time has come."""
        if job.id not in self._endings:
            return
        name, since = self._endings[job.id]
        order = list(SIGNALS)
        if name in self._patience and time.monotonic() - since > self._patience[name]:
            self._signal(job, order[order.index(name) + 1])

    def _signal(self, job: Job, name: str) -> None:
        self._endings[job.id] = name, time.monotonic()
        if job.pid is not None:
            # until its start, a process may ignore SIGINT, or answer it with a traceback; it has nothing to save yet
            events, begin = JobFolder(self.folder / job.id).events, self._heard.get(job.id, 0)
            early = name == "interrupt" and not has_started(events, begin)
            send(job.pid, job.identity, SIGNALS["terminate" if early else name], group=name == "kill")
            send(job.pid, job.identity, signal.SIGCONT, group=True)  # a stopped process would not see it

    def _ended(self, job: Job, code: int | None) -> None:
        """Note how a process ended: by its last event, else by its exit code."""
        self._children.pop(job.id, None)
        stopped = self._endings.pop(job.id, None)
        if job.state is State.PAUSED:
            self.hold(job, False)
        said = last_word(JobFolder(self.folder / job.id).events, self._heard.get(job.id, 0))
        changes: dict[str, Any] = {"state": State.INTERRUPTED, "line": "", "pid": None, "identity": ""}
        if isinstance(said, Finished):
            changes["state"] = State.DONE
        elif isinstance(said, Failed):
            changes |= {"state": State.FAILED, "line": one_line(said.line)}
        elif isinstance(said, Interrupted):
            changes["line"] = one_line(said.line)
        elif code is not None and code > 0:
            changes |= {"state": State.FAILED, "line": self._last_line(job, code)}
        else:
            changes["line"] = "its process ended without a word" if stopped is None else "it was ended"
        if job.cancelled and changes["state"] is not State.DONE:
            changes["state"] = State.CANCELLED
        self._put(job, ended=time.time(), **changes)

    def _last_line(self, job: Job, code: int) -> str:
        """Return the last line that a job printed, for a job that failed before it could write events."""
        with contextlib.suppress(OSError):
            with JobFolder(self.folder / job.id).output.open("rb") as file:
                file.seek(max(os.fstat(file.fileno()).st_size - LAST, 0))
                text = file.read().decode("utf-8", errors="replace").strip()
            if text:
                return one_line(text.splitlines()[-1])
        return f"ended with exit code {code}"

    def _recover(self) -> None:
        """Read the records that an earlier queue left, and find its processes. Nothing starts."""
        for path in sorted(self.folder.iterdir()):
            self._read(path)

    def _read(self, path: Path) -> None:
        """Read the record of a job that this queue does not know yet. It does not start."""
        if not ID.fullmatch(path.name):
            return
        folder = JobFolder(path)
        try:
            job = folder.read(self._render)
        except ArgumentError as error:
            self.damaged[path.name] = str(error)
            return
        if job.state in ACTIVE and job.pid is None and (found := last_start(folder.events)):
            # the earlier queue was killed between the start of the process and its note
            job = replace(job, pid=found.pid, identity=found.identity)
        self._jobs[job.id] = job
        if job.state in ACTIVE and not _is_of(job, folder):
            self._ended(replace(job, pid=None, identity=""), None)
        elif job.state is State.QUEUED:
            self._put(job, state=State.HELD)

    def _put(self, job: Job, **changes: Any) -> Job:  # noqa: ANN401
        job = replace(job, **changes)
        JobFolder(self.folder / job.id).write(job)
        self._note(job)
        return job

    def _note(self, job: Job) -> None:
        if job.state is State.QUEUED:
            self._turns.setdefault(job.id, max(self._turns.values(), default=0) + 1)
        else:
            self._turns.pop(job.id, None)
            job = replace(job, waits_for=())
        self._jobs[job.id] = job
        self.changed(job.id, job)


def _marker(folder: JobFolder) -> str:
    """Return the value of `EVENTS` in the environment of a job's processes, which identifies them."""
    return str(folder.events.resolve())


def _is_of(job: Job, folder: JobFolder) -> bool:
    """Return whether the process in a record runs and was started for this job. Only then may it get signals."""
    return (
        job.pid is not None
        and is_running(job.pid, job.identity)
        and carries(job.pid, EVENTS, _marker(folder))
    )

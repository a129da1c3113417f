"""State of the server: the library, its jobs, and the stream of their events."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec import structs

from gsplat_edu.jobs.following import last_stage
from gsplat_edu.jobs.queue import JobQueue
from gsplat_edu.jobs.record import ACTIVE, Job, State, Work
from gsplat_edu.server.refusal import conflict
from gsplat_edu.studio.commands import command_line, title_of, work_of
from gsplat_edu.studio.floaters import Proposals
from gsplat_edu.studio.library import HIDDEN, JOBS, Library
from gsplat_edu.studio.painter import Painter
from gsplat_edu.studio.renaming import FormerNames, names_along, rename_all
from gsplat_edu.studio.stream import Stream
from gsplat_edu.studio.uploads import Limits, Uploads
from gsplat_edu.studio.workers import Worker
from gsplat_edu.viewer.live_folder import LiveFolder

TRAINING = "training"
"""Stage of `train` that obeys the file `pause`."""


MOST_THUMBNAILS = 24
"""Largest number of waiting requests for thumbnails: those of four tabs. Each holds one of the server's 40 threads."""


class Studio:
    """A library with its jobs.

    Args:
        folder: The library's folder.
        at_once: Jobs that run at the same time.
        limits: How much may be taken in.
    """

    def __init__(self, folder: Path, at_once: int = 1, limits: Limits | None = None) -> None:
        self.stream = Stream()
        self.library = Library(folder, self.in_use, self.stream.library_changed)
        self.former = FormerNames(self.library.root / HIDDEN)
        self.uploads = Uploads(self.library, limits or Limits())
        self.worker, self.prober = (
            Worker(),
            Worker(),
        )  # two, so that a measurement does not delay a page
        self.decoder = Worker(waiting=MOST_THUMBNAILS)
        self.painter = Painter()
        self.proposals = Proposals()
        jobs = self.library.hidden(JOBS)
        self.queue = JobQueue(
            jobs,
            lambda work, purpose: command_line(self.library, work, purpose),
            at_once,
            self.stream.changed,
            hold=self._hold,
            identify=self.library.identity,
        )
        self._starting = threading.Lock()

    def start(self, request: Mapping[str, Any], begun_by: str = "", begun_at: str = "") -> Job:
        """Queue the job that a request describes.

        Args:
            request: See `gsplat_edu.studio.commands.work_of`.
            begun_by: See `Job`.
            begun_at: See `Job`.

        Raises:
            RefusedError: it is not allowed, or a job that waits or runs does the same or writes to the same place.
        """
        with self._starting:
            work = work_of(self.library, request)
            others = self._pending()
            if request.get("to") is None:  # the name is ours, and no reason to do the same work twice
                work = next(
                    (job.work for job in others if structs.replace(job.work, outputs=work.outputs) == work),
                    work,
                )
            self._check_first(work, others)
            return self.queue.submit(work, begun_by, begun_at)

    def resume(self, name: str) -> Job:
        """Continue a paused job, or queue one again; see `JobQueue.resume`.

        Raises:
            ArgumentError: it cannot be resumed, it is not allowed any more, or another job writes to the same place.
        """
        with self._starting:
            others = [job for job in self._pending() if job.id != name]
            self._check_first(self.queue.get(name).work, others)
            return self.queue.resume(name)

    def forget(self, name: str) -> str:
        """Move a job's record to the trash; return its id there. Errors as for `JobQueue.remove`."""
        with self.library.lock:  # first, as always where both are locked
            return self.queue.remove(name, self.library.discard)

    def restore(self, number: str) -> Path:
        """Move something back from the trash; see `Library.restore`."""
        with self.library.lock:
            path = self.library.restore(number)
            if path.parent == self.library.hidden(JOBS):
                self.queue.put_back(path.name)
        return path

    def _check_first(self, work: Work, others: list[Job]) -> None:
        """Check that no other job does the same work or writes to the same place.

        Raises:
            RefusedError: one does.
        """
        for job in others:
            if job.work == work or set(job.work.outputs) & set(work.outputs):
                title = title_of(job.work)
                raise conflict(f"job {job.id}: “{title}” works there; wait until it has ended, or stop it")

    def rename(self, kind: str, name: str, to: object) -> Path:
        """Give an entry another name; jobs that made or used it can be resumed there.

        Raises:
            RefusedError: see `Library.rename`.
        """
        library = self.library
        with library.lock:
            old, new = library.entry(kind, name), library.fresh(kind, to)
            self.queue.rename(library.name(old), library.name(new), lambda: library.rename(kind, name, to))
            self.former.note(library.name(old), library.name(new))
        return new

    def rename_along(self, kind: str, name: str, to: str, parents: Mapping[str, str]) -> dict[str, str]:
        """Give an entry another name, and likewise all that was made from it and named after it.

        Args:
            kind: Its kind.
            name: Its name.
            to: Its new name.
            parents: What each entry was made from.

        Returns:
            The new places by the old ones.

        Raises:
            RefusedError: a job uses one of them, or a name is taken; all have their old names then.
        """
        library = self.library
        with library.lock:
            places = names_along(library.name(library.entry(kind, name)), to, parents)
            for old, new in places.items():
                path = library.entry(*old.split("/", 1))
                if (used := self.in_use(path)) is not None:
                    raise conflict(f"{old}: {used}; nothing is renamed")
                library.fresh(*new.split("/", 1))
            rename_all(places, self._rename_place)
        return places

    def _rename_place(self, old: str, new: str) -> None:
        kind, _, name = old.partition("/")
        self.rename(kind, name, new.partition("/")[2])

    def close(self) -> None:
        """End running jobs with a checkpoint; waiting ones are held by the next start."""
        self.worker.close()
        self.prober.close()
        self.decoder.close()
        self.painter.close()
        self.proposals.close()
        self.queue.close()

    def is_training(self) -> bool:
        """Return whether a training runs that is not paused."""
        return any(job.state is State.RUNNING and job.work.command == "train" for job in self.queue.jobs())

    def _hold(self, job: Job, wait: bool) -> bool:
        """Pause a training between two iterations, where its clock stops, if it has started to train."""
        if job.work.command != "train":
            return False
        folder = LiveFolder(self.library.root / job.work.outputs[0])
        if not self.library.is_within(folder.pause):
            return False
        if not wait:
            folder.set_paused(False)
            return False
        if last_stage(self.queue.files(job.id).events) != TRAINING:
            return False
        folder.set_paused(True)
        return True

    def _pending(self) -> list[Job]:
        return [job for job in self.queue.jobs() if job.state in (*ACTIVE, State.QUEUED)]

    def in_use(self, path: Path) -> str | None:
        """Return which job uses a path of the library, which may then not be moved."""
        for job in self._pending():
            if job.work.uses(self.library.name(path)):
                return f"is used by “{title_of(job.work)}”; wait until that has ended, or stop it"
        return None

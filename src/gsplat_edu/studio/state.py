"""What the server has open: the library, its jobs, and what watches them."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsplat_edu.jobs.following import last_stage
from gsplat_edu.jobs.queue import JobQueue
from gsplat_edu.jobs.record import ACTIVE, Job, Purpose, State, Work
from gsplat_edu.studio.commands import renamed, work_of
from gsplat_edu.studio.library import Library
from gsplat_edu.studio.painter import Painter
from gsplat_edu.studio.refusal import conflict
from gsplat_edu.studio.stream import Stream
from gsplat_edu.studio.uploads import Limits, Uploads
from gsplat_edu.studio.workers import Worker
from gsplat_edu.viewer.live_folder import LiveFolder

TRAINING = "training"
"""Stage of `train` in which it looks at the file that lets it wait."""


MOST_THUMBNAILS = 24
"""Thumbnails that wait to be made: those of four tabs. Each holds one of the server's 40 threads."""


class Studio:
    """A library with its jobs.

    Args:
        folder: The library's folder.
        at_once: Jobs that run at the same time.
        limits: How much may be taken in.
    """

    def __init__(self, folder: Path, at_once: int = 1, limits: Limits | None = None) -> None:
        self.library = Library(folder, self.in_use)
        self.uploads = Uploads(self.library, limits or Limits())
        self.stream = Stream()
        self.worker, self.prober = Worker(), Worker()  # a measurement must not hold up a page
        self.decoder = Worker(waiting=MOST_THUMBNAILS)
        self.painter = Painter()
        jobs = self.library.hidden("jobs")
        self.queue = JobQueue(jobs, self._work, at_once, self.stream.changed, hold=self._hold)
        self._starting = threading.Lock()

    def start(self, request: Mapping[str, Any]) -> Job:
        """Queue the job that a request describes.

        Raises:
            RefusedError: it is not allowed, or a job that waits or runs writes to the same place.
        """
        with self._starting:
            return self.queue.submit(self._work(request, Purpose.BEGIN))

    def resume(self, name: str) -> Job:
        """Continue a paused job, or queue one again; see `JobQueue.resume`.

        Raises:
            ArgumentError: it cannot be resumed, it is not allowed any more, or another job writes to the same place.
        """
        with self._starting:
            return self.queue.resume(name)

    def _work(self, request: Mapping[str, Any], purpose: Purpose) -> Work:
        """Turn a request into a command line; see `work_of`."""
        work = work_of(self.library, request, purpose)
        for job in () if purpose is Purpose.SHOW else self._pending():
            if job.argv == work.argv or set(_places(work.argv)) & set(_outputs(job.argv)):
                raise conflict(f"job {job.id}: {job.title} works there; wait until it ends, or cancel it")
        return work

    def rename(self, kind: str, name: str, to: object) -> Path:
        """Give an entry another name; jobs that made or used it can be resumed there.

        Raises:
            RefusedError: see `Library.rename`.
        """
        library = self.library
        with library.lock:
            old, new = library.entry(kind, name), library.fresh(kind, to)
            self.queue.move(
                old,
                new,
                lambda request: renamed(request, kind, old.name, new.name),
                lambda: library.rename(kind, name, to),
            )
        return new

    def close(self) -> None:
        """End running jobs with a checkpoint; waiting ones are held by the next start."""
        self.worker.close()
        self.prober.close()
        self.decoder.close()
        self.painter.close()
        self.queue.close()

    def is_training(self) -> bool:
        """Return whether a training runs, and does not wait."""
        return any(job.state is State.RUNNING and job.argv[0] == "train" for job in self.queue.jobs())

    def _hold(self, job: Job, wait: bool) -> bool:
        """Let a training wait between two iterations, where its clock stops, if it has come that far."""
        if job.argv[0] != "train":
            return False
        folder = LiveFolder(Path(job.argv[job.argv.index("--out") + 1]))
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
            if any(Path(word).is_relative_to(path) for word in job.argv if word.startswith("/")):
                return f"is used by job {job.id} ({job.title}); wait until it ends, or cancel it"
        return None


def _places(argv: tuple[str, ...]) -> list[str]:
    return [word for word in argv if word.startswith("/")]


def _outputs(argv: tuple[str, ...]) -> list[str]:
    """Return the paths that a command writes."""
    if argv[0] == "doctor":
        return []
    if "--out" in argv[:-1]:
        return [argv[argv.index("--out") + 1]]
    return _places(argv)[1:2]

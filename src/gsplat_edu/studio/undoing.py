"""Undo of a training that a proposal of the doctor began."""

from __future__ import annotations

from http import HTTPStatus

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import printable, shortened
from gsplat_edu.jobs.record import ACTIVE, Job, State
from gsplat_edu.server.refusal import RefusedError, conflict
from gsplat_edu.studio.replies import fields
from gsplat_edu.studio.state import Studio

LONGEST_LABEL = 100
"""Characters of a proposal's words."""


def beginning(studio: Studio, begun: object) -> tuple[str, str]:
    """Return the words of the proposal that begins a training, and the place for which it was made.

    Args:
        studio: The studio.
        begun: Of a request: by, the words, and at, the place ("captures/toy").

    Raises:
        RefusedError: it is not that, or there is no such place.
    """
    given = fields(begun, by=str, at=str)
    label, (kind, _, name) = given["by"], given["at"].partition("/")
    if not label or len(label) > LONGEST_LABEL or printable(label) != label:
        raise RefusedError(f"by: has to be a line of at most {LONGEST_LABEL} characters")
    if kind not in ("captures", "runs"):
        raise RefusedError(f"at: is {shortened(given['at'])!r}, but has to be a capture or a run")
    return label, studio.library.name(studio.library.entry(kind, name))


def undo(studio: Studio, name: str, created: float) -> Job | None:
    """Stop a training that a proposal began, or move its run to the trash and forget the job, if it has stopped.

    Args:
        studio: The studio.
        name: The job's id.
        created: When it was made: a later job may have the id of one that was undone.

    Returns:
        The job while it has not stopped yet; None if it is undone, also by an earlier request.

    Raises:
        RefusedError: no proposal began it, its result was kept, or another job uses its run.
    """
    job = _job(studio, name, created)
    if job is None:
        return None
    if not job.begun_by:
        raise conflict(f"job {job.id}: its result was kept; remove the run instead")
    if not job.cancelled and job.state in (State.QUEUED, State.HELD, *ACTIVE):
        try:
            job = studio.queue.cancel(job.id)
        except ArgumentError:  # it has ended meanwhile
            return undo(studio, name, created)
    if job.state in ACTIVE:
        return job
    with studio.library.lock:  # another tab may undo it at the same time
        if _job(studio, name, created) is not None:
            _remove(studio, job)
    return None


def _remove(studio: Studio, job: Job) -> None:
    """Move the run of a job to the trash, unless a later job made it again, and forget the job.

    Raises:
        RefusedError: another job uses the run.
    """
    (output,) = job.work.outputs
    makers = [other.id for other in studio.queue.jobs() if output in other.work.outputs]
    try:
        if makers[-1:] == [job.id]:
            studio.library.remove(*output.split("/", 1))
    except RefusedError as error:  # one that only waited has no folder
        if error.status != HTTPStatus.NOT_FOUND:
            raise
    studio.queue.remove(job.id)


def _job(studio: Studio, name: str, created: float) -> Job | None:
    return next((job for job in studio.queue.jobs() if (job.id, job.created) == (name, created)), None)

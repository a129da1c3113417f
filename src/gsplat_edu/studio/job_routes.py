"""Routes of the jobs, and the stream of their events."""

from __future__ import annotations

import os
from numbers import Real
from typing import Any

from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Route

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.text import shortened, whole_of
from gsplat_edu.jobs.following import events_after
from gsplat_edu.jobs.record import Job
from gsplat_edu.server.refusal import RefusedError, conflict, not_found
from gsplat_edu.studio.replies import act, fields
from gsplat_edu.studio.state import Studio
from gsplat_edu.studio.stream import event_document, job_document
from gsplat_edu.studio.undoing import beginning, undo

MOST_EVENTS = 2_000
"""Events of a job in one answer: the latest ones."""

MOST_OUTPUT = 1 << 20
"""Bytes of a job's output in one answer: the last ones."""


def routes() -> list[BaseRoute]:
    """Return the routes."""
    return [
        act("/api/jobs", "GET", _jobs),
        act("/api/jobs", "POST", _start),
        act("/api/jobs/{id}", "GET", lambda studio, request, body: job_document(_job(studio, request))),
        act("/api/jobs/{id}", "DELETE", _remove),
        act("/api/jobs/{id}/events", "GET", _events),
        act("/api/jobs/{id}/output", "GET", _output),
        act("/api/jobs/{id}/undo", "POST", _undo),
        act("/api/jobs/{id}/{action}", "POST", _change),
        Route("/api/events", _stream, methods=["GET"]),
    ]


def _jobs(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    return {
        "boot": studio.stream.boot,
        "jobs": [job_document(job) for job in studio.queue.jobs()],
        "damaged": [{"id": name, "line": line} for name, line in sorted(studio.queue.damaged.items())],
    }


def _start(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    if not isinstance(body, dict):
        raise RefusedError("body: has to be an object")
    begun = beginning(studio, body["begun"]) if "begun" in body else ("", "")
    asked = {name: value for name, value in body.items() if name != "begun"}
    return job_document(studio.start(asked, *begun))


def _job(studio: Studio, request: Request) -> Job:
    name = request.path_params["id"]
    try:
        return studio.queue.get(name)
    except ArgumentError:
        raise not_found(f"jobs/{shortened(name)}") from None


def _change(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    job, action = _job(studio, request), request.path_params["action"]
    queue = studio.queue
    actions = {"cancel": queue.cancel, "pause": queue.pause, "resume": studio.resume, "keep": queue.keep}
    if action not in actions:
        raise not_found(f"jobs/{job.id}/{shortened(action)}")
    try:
        return job_document(actions[action](job.id))
    except ArgumentError as error:
        raise conflict(str(error)) from None


def _undo(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    job = undo(studio, request.path_params["id"], fields(body, created=Real)["created"])
    return {"undone": job is None}


def _remove(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    name = request.path_params["id"]
    if name not in studio.queue.damaged:
        _job(studio, request)
    try:
        return {"trash": studio.forget(name)}
    except ArgumentError as error:
        raise conflict(str(error)) from None


def _events(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    after = whole_of(request.query_params.get("after", "0"))
    if after is None:
        raise RefusedError("after: has to be the number of an event")
    found = events_after(studio.queue.files(_job(studio, request).id).events, after)
    return {
        "events": [event_document(*entry) for entry in found[-MOST_EVENTS:]],
        "left_out": max(len(found) - MOST_EVENTS, 0),
    }


def _output(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    path = studio.queue.files(_job(studio, request).id).output
    text = ""
    if path.is_file():
        with open_file(path) as file:
            file.seek(max(os.fstat(file.fileno()).st_size - MOST_OUTPUT, 0))
            text = file.read().decode("utf-8", errors="replace")
    return PlainTextResponse(text)


async def _stream(request: Request) -> Response:
    studio: Studio = request.app.state.studio
    lines = studio.stream.watch(request.headers.get("last-event-id"))
    return StreamingResponse(lines, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})

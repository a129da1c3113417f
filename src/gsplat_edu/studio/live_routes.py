"""Routes of a training that runs as a job: its page, its state, its newest splats, and pause.

They have the addresses that the live page of `train --view` uses (`gsplat_edu.viewer.live`), but read the files that
the training writes (`gsplat_edu.viewer.live_folder`), and make the training write them only while a page asks for them.
"""

from __future__ import annotations

import asyncio
import time
from http import HTTPStatus
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.locks import POLL
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.jobs.record import ACTIVE, Job, State
from gsplat_edu.server.bodies import Json
from gsplat_edu.server.refusal import RefusedError, conflict
from gsplat_edu.studio.replies import act, answered
from gsplat_edu.studio.scene_routes import BINARY, page_answer
from gsplat_edu.studio.state import Studio
from gsplat_edu.viewer.live_folder import WAIT, LiveFolder, header_of

PAGE_WAIT = 5.0
"""Seconds that the page waits for the training to write its facts."""


def routes() -> list[BaseRoute]:
    """Return the routes."""
    return [
        act("/api/runs/{name}/live/page", "GET", _page),
        Route("/api/runs/{name}/live/state", answered(_state), methods=["GET"]),
        Route("/api/runs/{name}/live/scene", answered(_scene), methods=["GET"]),
        Route("/api/runs/{name}/live/control", answered(_control), methods=["POST"]),
        act("/api/runs/{name}/live/picture", "POST", _picture),
    ]


def _live(studio: Studio, request: Request) -> tuple[Job, LiveFolder]:
    """Ask for a training's files; return its job and the files.

    Raises:
        RefusedError: no job trains it.
    """
    entry = studio.library.place("runs", request.path_params["name"])
    name = studio.library.name(entry)
    for job in studio.queue.jobs():
        if job.state in ACTIVE and job.work.command == "train" and job.work.outputs == (name,):
            folder = LiveFolder(entry)
            if (entry / "config.json").is_file():
                folder.ask()
            return job, folder
    raise conflict(f"runs/{entry.name}: is not being trained; show its scene instead")


def _page(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    until = time.monotonic() + PAGE_WAIT
    while not (files := _live(studio, request))[1].page.is_file():
        if time.monotonic() > until:
            raise RefusedError(
                f"{files[1].run.name}: has not begun to train; try again in a few seconds",
                HTTPStatus.SERVICE_UNAVAILABLE,
            )
        time.sleep(POLL)
    job, folder = files
    target = studio.library.hidden("cache") / "live" / f"{job.id}-{job.attempts}.html"
    policy = target.with_suffix(".policy")
    if not (target.is_file() and policy.is_file()):
        made = studio.worker.ask("live_page", facts=str(folder.page), out=str(target))
        with written_aside(policy) as aside:
            aside.write_text(made["policy"], encoding="utf-8")
    return page_answer(request, target, policy.read_text("utf-8"))


async def _state(request: Request) -> Response:
    after = request.query_params.get("after", "")
    found = await _waited(request, lambda job, folder: _new_state(job, folder, after))
    return Response(status_code=204) if found is None else Json(found)


def _new_state(job: Job, folder: LiveFolder, after: str) -> dict[str, Any] | None:
    """Return the state with its version; None if the page has this version."""
    try:
        version = folder.state.stat().st_mtime_ns // 1_000_000 * 2
        state = folder.read_state()
    except (OSError, SceneFormatError):
        return None
    if state is None:
        return None
    if job.state is State.PAUSED and state.get("state") == "training":
        state["state"], version = "paused", version + 1
    return None if str(version) == after else {**state, "version": version}


async def _scene(request: Request) -> Response:
    after = request.query_params.get("after", "")

    def new(job: Job, folder: LiveFolder) -> bytes | None:
        try:
            header = header_of(folder.scene)
            if header is None or str(header.get("iteration")) == after:
                return None
            return read_bytes(folder.scene)
        except (OSError, SceneFormatError):
            return None

    found = await _waited(request, new)
    return Response(status_code=204) if found is None else Response(found, media_type=BINARY)


async def _waited(request: Request, look: Any) -> Any:  # noqa: ANN401
    """Look for something new until `WAIT` seconds have passed."""
    studio: Studio = request.app.state.studio
    until = time.monotonic() + WAIT
    while True:
        job, folder = await run_in_threadpool(_live, studio, request)
        found = await run_in_threadpool(look, job, folder)
        if found is not None or time.monotonic() > until:
            return found
        await asyncio.sleep(POLL)


async def _control(request: Request) -> Response:
    studio: Studio = request.app.state.studio
    job, _ = await run_in_threadpool(_live, studio, request)
    body = bytearray()
    async for piece in request.stream():
        body += piece
        if len(body) > 1000:
            raise RefusedError("body: is too long")
    try:
        wanted = parse_json(bytes(body))["do"]
    except (ValueError, KeyError, TypeError):
        wanted = None
    actions = {"pause": studio.queue.pause, "resume": studio.queue.resume}
    if wanted not in actions:
        raise RefusedError(f"do: is {str(wanted)[:20]!r}, but has to be one of {', '.join(actions)}")
    try:
        await run_in_threadpool(actions[wanted], job.id)
    except ArgumentError as error:
        raise conflict(str(error)) from None
    return Response(status_code=204)


def _picture(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    _, folder = _live(studio, request)
    until = time.monotonic() + PAGE_WAIT
    while not folder.scene.is_file():  # the training writes it soon after it was asked
        if time.monotonic() > until:
            raise RefusedError(
                f"{folder.run.name}: has no picture yet; it comes in a few seconds",
                HTTPStatus.SERVICE_UNAVAILABLE,
            )
        time.sleep(POLL)
        folder.ask()
    data = studio.painter.paint(studio.is_training, source=str(folder.run), camera=body, live=True)
    return Response(data, media_type="image/jpeg")

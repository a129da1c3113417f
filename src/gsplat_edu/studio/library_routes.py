"""Routes of the library: list, upload, rename and remove entries."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.text import legible
from gsplat_edu.jobs.record import State
from gsplat_edu.options.studio import PORT
from gsplat_edu.server.bodies import Json, content_length
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.library import JOBS
from gsplat_edu.studio.listing import summaries, summary
from gsplat_edu.studio.origins import makers, origins
from gsplat_edu.studio.pictures import leave_out, photo_list, thumbnail
from gsplat_edu.studio.projects import projects
from gsplat_edu.studio.replies import act, answered, entry_of, fields, file_answer
from gsplat_edu.studio.state import Studio

MOST_LINES = 3
"""Largest number of lines that the page shows for one problem; beyond it, only their number."""


def routes() -> list[BaseRoute]:
    """Return the routes."""
    return [
        act("/api/library", "GET", _library),
        act("/api/adopt", "POST", _adopt),
        act("/api/example", "POST", lambda studio, request, body: studio.uploads.add_example()),
        act("/api/names", "POST", _promise),
        act("/api/names/{kind}/{name}", "DELETE", _release),
        act("/api/trash", "GET", lambda studio, request, body: {"trash": studio.library.trash()}),
        act("/api/trash", "DELETE", _empty_trash),
        act("/api/trash/{id}/restore", "POST", _restore),
        act("/api/{kind}/{name}", "GET", _entry),
        act("/api/{kind}/{name}", "DELETE", _remove),
        act("/api/{kind}/{name}/rename", "POST", _rename),
        act("/api/{kind}/{name}/photos", "GET", _photos),
        act("/api/photos/{name}/checks", "GET", _checks),
        act("/api/{kind}/{name}/left-out", "POST", _leave_out),
        act("/api/{kind}/{name}/thumbs/{path:path}", "GET", _thumb),
        Route("/api/{kind}/{name}/files/{path:path}", answered(_upload), methods=["PUT"]),
        Route("/api/{kind}/{name}/zip", answered(_upload_zip), methods=["PUT"]),
    ]


def _library(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    library = studio.library
    unreadable: list[str] = []
    lists = summaries(library, unreadable)
    grouped = projects(library, lists, studio.queue.jobs(), studio.former)
    return {
        "folder": legible(str(library.root)),
        "start": _start_command(studio, request),
        "free_bytes": shutil.disk_usage(library.root).free,
        "used_bytes": studio.uploads.used(),
        "trash_bytes": studio.uploads.trash_size(),
        "limits": studio.uploads.limits.document(),
        "jobs_at_once": studio.queue.at_once,
        "waiting": sum(job.state is State.QUEUED for job in studio.queue.jobs()),
        "trouble": [
            *_few(
                list(studio.queue.damaged.values()),
                "records of jobs are damaged; the page of jobs lists them",
            ),
            *_few(library.strange_links(), "entries are links that were not adopted here, or lead nowhere"),
            *_few(unreadable, "entries cannot be read"),
            *([studio.queue.trouble] if studio.queue.trouble else []),
        ],
        "projects": grouped,
        **lists,
    }


def _start_command(studio: Studio, request: Request) -> str:
    """Return the command that starts this server again, with the same library and at the same address."""
    host, port = request.app.state.host, request.scope["server"][1]
    words = ["gsplat-edu", "studio", legible(str(studio.library.root))]
    words += ["--host", host] if host != LOOPBACK else []
    words += ["--port", str(port)] if port != PORT else []
    words += ["--jobs", str(studio.queue.at_once)] if studio.queue.at_once > 1 else []
    return shlex.join(words)


def _few(lines: list[str], summary: str) -> list[str]:
    """Return the lines if they are at most `MOST_LINES`, else a line with their number."""
    return lines if len(lines) <= MOST_LINES else [f"{len(lines)} {summary}"]


def _entry(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    return summary(studio.library, *entry_of(studio, request))


def _adopt(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    given = fields(body, kind=str, path=str, **({"name": str} if body and "name" in body else {}))
    path = studio.library.adopt(given["kind"], Path(given["path"]), given.get("name"))
    return summary(studio.library, given["kind"], path)


def _promise(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    given = fields(body, kind=str, wish=str)
    name = legible(studio.library.promise(given["kind"], given["wish"]))
    return {"kind": given["kind"], "name": name, "entry": f"{given['kind']}/{name}"}


def _release(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    kind, name = request.path_params["kind"], request.path_params["name"]
    studio.library.release(kind, name)
    return {"released": f"{kind}/{name}"}


def _rename(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    kind, name = request.path_params["kind"], request.path_params["name"]
    along = isinstance(body, dict) and "along" in body
    given = fields(body, to=str, **({"along": bool} if along else {}))
    if not given.get("along"):
        return summary(studio.library, kind, studio.rename(kind, name, given["to"]))
    parents = origins(studio.library, summaries(studio.library), makers(studio.queue.jobs()), studio.former)
    places = studio.rename_along(kind, name, given["to"], parents)
    made = studio.library.entry(kind, given["to"])
    return summary(studio.library, kind, made) | {"renamed": places}


def _remove(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    number = studio.library.remove(request.path_params["kind"], request.path_params["name"])
    return {"trash": number}


def _restore(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    path = studio.restore(request.path_params["id"])
    if path.parent == studio.library.hidden(JOBS):
        return {"kind": JOBS, "name": path.name, "entry": f"{JOBS}/{path.name}"}
    return summary(studio.library, path.parent.name, path)


def _empty_trash(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    studio.library.empty_trash()
    studio.uploads.recount()
    return {"trash": studio.library.trash()}


def _photos(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    kind, entry = entry_of(studio, request)
    if kind not in ("photos", "captures"):
        raise RefusedError(f"{kind}: have no photos of their own; request the photos of a capture")
    return {"photos": photo_list(entry)}


def _checks(studio: Studio, request: Request, body: Any) -> Any:  # noqa: ANN401
    entry = studio.library.entry("photos", request.path_params["name"])
    cache = studio.library.hidden("cache") / "checks"
    return studio.decoder.ask("check_photos", entry=str(entry), cache=str(cache))


def _leave_out(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    kind, entry = entry_of(studio, request)
    given = fields(body, photos=list, back=bool)
    if kind != "captures" or not all(isinstance(photo, str) for photo in given["photos"]):
        raise RefusedError("photos: has to be a list of photos of a capture")
    with studio.library.lock:  # two tabs may change the list at the same time
        left = leave_out(entry, given["photos"], given["back"])
    studio.stream.library_changed()
    return {"left_out": left}


def _thumb(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    _, entry = entry_of(studio, request)
    side = request.query_params.get("side", "256")
    path = thumbnail(studio.decoder, studio.library, entry, request.path_params["path"], side)
    return file_answer(request, path, "image/jpeg")


async def _upload(request: Request) -> Response:
    studio: Studio = request.app.state.studio
    kind, name = request.path_params["kind"], request.path_params["name"]
    target = studio.uploads.target(kind, name, request.path_params["path"])
    size = await studio.uploads.receive(request.stream(), _length(request), target)
    return Json({"entry": f"{kind}/{name}", "file": target.name, "bytes": size}, 201)


async def _upload_zip(request: Request) -> Response:
    studio: Studio = request.app.state.studio
    kind, name = request.path_params["kind"], request.path_params["name"]
    return Json(await studio.uploads.receive_zip(request.stream(), _length(request), kind, name), 201)


def _length(request: Request) -> int | None:
    length = content_length(request)
    if length == 0:
        raise RefusedError("file: is empty; choose another one")
    return length

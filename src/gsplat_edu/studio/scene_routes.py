"""Routes of scenes and the scenes of runs: their page, edits, exports and downloads."""

from __future__ import annotations

import hashlib
import threading
from http import HTTPStatus
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from gsplat_edu.base.errors import CheckpointError, SplatError
from gsplat_edu.base.files import described, newest_first, written_aside
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.base.text import bounded, legible
from gsplat_edu.edits.stored import MOST_BYTES, version_of
from gsplat_edu.jobs.events import Metric
from gsplat_edu.jobs.following import events_after
from gsplat_edu.jobs.record import State
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.server.bodies import content_length, drain
from gsplat_edu.server.refusal import RefusedError, not_found, too_large
from gsplat_edu.studio.commands import EDITS, FORMATS, MESHES, scene_of
from gsplat_edu.studio.library import EXPORTS, Library
from gsplat_edu.studio.names import LONGEST_FILE, below, checked_name
from gsplat_edu.studio.replies import CLOSE, act, entry_of, file_answer
from gsplat_edu.studio.state import Studio

KEPT_PAGES = 12
"""Pages in the cache."""

ENDINGS = sorted((*FORMATS, *MESHES.values()), key=len)[::-1]
"""Endings of exported files, longest first."""

BINARY = "application/octet-stream"

_storing = threading.Lock()
"""Held while a request compares edits with the stored version and writes them."""


def routes() -> list[BaseRoute]:
    """Return the routes."""
    return [
        act("/api/{kind}/{name}/page", "GET", _page),
        act("/api/{kind}/{name}/picture", "POST", _picture),
        act("/api/{kind}/{name}/cover", "GET", _cover),
        act("/api/{kind}/{name}/scene", "GET", _download),
        act("/api/{kind}/{name}/exports", "GET", _exports),
        act("/api/{kind}/{name}/exports/{file}", "GET", _export),
        act("/api/{kind}/{name}/exports/{file}", "DELETE", _remove_export),
        Route("/api/{kind}/{name}/edits.json", _plain(_edits), methods=["GET"]),
        Route("/api/{kind}/{name}/edits.json", _plain(_store_edits), methods=["PUT"]),
    ]


def current_scene(library: Library, entry: Path, kind: str) -> Path:
    """Return the file of an entry's scene, the latest one of a run.

    Raises:
        RefusedError: it has none, or it leads out of the library.
    """
    try:
        scene = RunFolder(entry).latest_scene()[0] if kind == "runs" else scene_of(entry, kind)
    except CheckpointError as error:
        raise RefusedError(str(error), HTTPStatus.NOT_FOUND) from None
    library.check_within(scene)
    return scene


def _page(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    kind, entry = entry_of(studio, request)
    scene = current_scene(studio.library, entry, kind)
    facts = scene.stat()
    editing = request.query_params.get("edit") == "1"
    applied = {} if editing else _applied(studio, entry, request)
    meshes = {name: path for name in MESHES if (path := _mesh_file(entry, request, name)) is not None}
    states = [(str(path), path.stat().st_mtime_ns, path.stat().st_size) for path in meshes.values()]
    states += [(path, *_state(Path(path))) for path in applied.values()]
    key = f"{scene} {facts.st_mtime_ns} {facts.st_size} {entry.name} {editing} {states or ''}"
    task = {"source": str(scene_of(entry, kind)), "title": legible(entry.name)}
    if editing:
        task |= {"edits": str(entry / EDITS), "url": EDITS}
    task |= {name: str(path) for name, path in meshes.items()} | applied
    return cached_page(studio, request, key, "page", task)


def cached_page(studio: Studio, request: Request, key: str, name: str, task: dict[str, str]) -> Response:
    """Return a page from the cache, made if it is not there.

    Args:
        studio: The studio.
        request: The request.
        key: What the page depends on.
        name: Name of the worker's task that makes it and returns its policy.
        task: The task's arguments, but for `out`, the file to write.

    Raises:
        RefusedError: the page cannot be made.
    """
    digest = hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()
    target = studio.library.hidden("cache") / "pages" / f"{digest}.html"
    policy = target.with_suffix(".policy")
    if not (target.is_file() and policy.is_file()):
        made = studio.worker.ask(name, **task, out=str(target))
        with written_aside(policy) as aside:
            aside.write_text(made["policy"], encoding="utf-8")
        _prune(target.parent)
    return page_answer(request, target, policy.read_text("utf-8"))


def _mesh_file(entry: Path, request: Request, parameter: str) -> Path | None:
    """Return the exported mesh that a parameter of the address names; None without the parameter."""
    given = request.query_params.get(parameter)
    if given is None:
        return None
    name = checked_name(parameter, given, LONGEST_FILE)
    path = below(entry, Path(EXPORTS, name), parameter)
    if not name.endswith(tuple(f".{ending}" for ending in MESHES.values())) or not path.is_file():
        raise not_found(f"{entry.name}/{EXPORTS}/{name}")
    return path


def _picture(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    kind, entry = entry_of(studio, request)
    current_scene(studio.library, entry, kind)
    if body is None:
        raise RefusedError("body: has to be a camera")
    source = str(scene_of(entry, kind))
    applied = _applied(studio, entry, request)
    data = studio.painter.paint(studio.is_training, source=source, camera=body, live=False, **applied)
    return Response(data, media_type="image/jpeg")


def _cover(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    """Return a small picture of a scene from its start view, with its saved edits if they fit it."""
    kind, entry = entry_of(studio, request)
    scene = current_scene(studio.library, entry, kind)
    task: dict[str, Any] = {"source": str(scene_of(entry, kind)), "camera": None, "live": False}
    edits = _saved_edits(studio.library, entry)
    key = f"{scene} {_state(scene)} {_state(edits) if edits else ''}"
    digest = hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()
    target = studio.library.hidden("cache") / "covers" / f"{digest}.jpg"
    if not target.is_file():
        try:
            applied = {"applied": str(edits)} if edits else {}
            data = studio.painter.paint(studio.is_training, **task, **applied)
        except RefusedError as error:
            if not edits or error.status is not HTTPStatus.BAD_REQUEST:
                raise
            data = studio.painter.paint(studio.is_training, **task)  # the edits are of an earlier scene
        with written_aside(target) as aside:
            aside.write_bytes(data)
    return file_answer(request, target, "image/jpeg")


def _saved_edits(library: Library, entry: Path) -> Path | None:
    """Return the file of an entry's edits; None if there is none."""
    path = entry / EDITS
    if not path.is_file():
        return None
    library.check_within(path)
    return path


def _applied(studio: Studio, entry: Path, request: Request) -> dict[str, str]:
    """Return the argument of a worker's task for the saved edits, if the address asks for them and there are some."""
    wanted = request.query_params.get("edited") == "1"
    edits = _saved_edits(studio.library, entry) if wanted else None
    return {"applied": str(edits)} if edits else {}


def _state(path: Path) -> tuple[int, int]:
    facts = path.stat()
    return facts.st_mtime_ns, facts.st_size


def page_answer(request: Request, path: Path, policy: str) -> Response:
    """Return one of our pages with the policy that allows its own scripts; the studio's page may show it in a frame."""
    answer = file_answer(request, path, "text/html; charset=utf-8")
    answer.headers["Content-Security-Policy"] = f"{policy}; frame-ancestors 'self'"
    return answer


def _prune(folder: Path) -> None:
    """Remove the oldest pages of the cache."""
    for path in newest_first(folder.glob("*.html"))[KEPT_PAGES:]:
        path.unlink(missing_ok=True)
        path.with_suffix(".policy").unlink(missing_ok=True)


def _download(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    kind, entry = entry_of(studio, request)
    scene = current_scene(studio.library, entry, kind)
    if scene.suffix == ".json":
        raise RefusedError(f"{kind}/{entry.name}: is a folder of files; export it to download it")
    return file_answer(request, scene, BINARY, download=f"{entry.name}{scene.suffix}")


def _exports(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    kind, entry = entry_of(studio, request)
    if kind not in ("runs", "scenes"):
        raise RefusedError(f"{kind}: have no exports; choose a run or a scene")
    folder = entry / EXPORTS
    found = []
    for path in sorted(folder.iterdir()) if folder.is_dir() and not folder.is_symlink() else ():
        if path.name[0] == "." or path.is_symlink() or not path.is_file():
            continue
        form = next((form for form in ENDINGS if path.name.endswith(f".{form}")), None)
        try:
            facts = path.stat()
        except FileNotFoundError:  # it has just been removed
            continue
        found.append(
            {
                "file": legible(path.name),
                "format": form or path.suffix[1:],
                "bytes": facts.st_size,
                "modified": facts.st_mtime,
                **_made_by(studio, path),
            }
        )
    return {"exports": found}


def _made_by(studio: Studio, path: Path) -> dict[str, Any]:
    """Return the job that wrote a file last, its command, and the PSNR that it measured; None where unknown."""
    place = studio.library.name(path)
    for job in reversed(studio.queue.jobs()):
        if job.state is State.DONE and place in job.work.outputs:
            metrics = [event for _, _, event in events_after(studio.queue.files(job.id).events)]
            measured = (
                m for m in metrics if isinstance(m, Metric) and Path(m.of).name == path.name
            )  # it may have moved
            of = {m.name: m.value for m in measured}
            return {"job": job.id, "command": job.command, "psnr": of.get("psnr")}
    return {"job": None, "command": None, "psnr": None}


def _export_file(studio: Studio, request: Request) -> Path:
    _, entry = entry_of(studio, request)
    name = checked_name("file", request.path_params["file"], LONGEST_FILE)
    path = below(entry, Path(EXPORTS, name), "file")
    if not path.is_file():
        raise not_found(f"{entry.name}/{EXPORTS}/{name}")
    return path


def _export(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    path = _export_file(studio, request)
    return file_answer(request, path, BINARY, download=path.name)


def _remove_export(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    return {"trash": studio.library.discard(_export_file(studio, request))}


def _plain(endpoint: Any) -> Any:  # noqa: ANN401
    """Turn errors into plain text, which the editor shows."""

    async def safe(request: Request) -> Response:
        try:
            return await endpoint(request)  # type: ignore[no-any-return]
        except RefusedError as error:
            line, status = str(error), error.status
        except SplatError as error:
            line, status = str(error), HTTPStatus.BAD_REQUEST
        except OSError as error:
            line, status = described(error), HTTPStatus.INTERNAL_SERVER_ERROR
        await drain(request, status)
        return PlainTextResponse(f"{bounded(legible(line))}\n", status, headers=CLOSE)

    return safe


def _stored(entry: Path) -> bytes | None:
    path = entry / EDITS
    return read_bytes(path) if path.is_file() else None


async def _edits(request: Request) -> Response:
    studio: Studio = request.app.state.studio
    kind, entry = entry_of(studio, request)
    await run_in_threadpool(current_scene, studio.library, entry, kind)
    data = await run_in_threadpool(_stored, entry)
    headers = {"ETag": f'"{version_of(data)}"'}
    return Response(b"null\n" if data is None else data, media_type="application/json", headers=headers)


async def _store_edits(request: Request) -> Response:
    studio: Studio = request.app.state.studio
    kind, entry = entry_of(studio, request)
    if (content_length(request) or 0) > MOST_BYTES:
        raise too_large(f"{EDITS}: may have {MOST_BYTES:,} bytes")
    received = bytearray()
    async for piece in request.stream():
        received += piece
        if len(received) > MOST_BYTES:
            raise too_large(f"{EDITS}: may have {MOST_BYTES:,} bytes")
    data = bytes(received)
    expected = request.headers.get("if-match", "").strip('"')
    version = await run_in_threadpool(_store, studio, kind, entry, data, expected)
    return PlainTextResponse("saved\n", headers={"ETag": f'"{version}"'})


def _store(studio: Studio, kind: str, entry: Path, data: bytes, expected: str) -> str:
    """Check and store edits; refuse them if another tab has stored edits since this one read them."""
    part = studio.library.part(".json")
    try:
        part.write_bytes(data)
        studio.worker.ask("check_edits", path=str(part), name=EDITS, source=str(scene_of(entry, kind)))
    finally:
        part.unlink(missing_ok=True)
    with _storing:
        if version_of(_stored(entry)) != expected:
            raise RefusedError(
                f"{EDITS} was changed elsewhere; download these edits, then reload the page",
                HTTPStatus.PRECONDITION_FAILED,
            )
        with written_aside(entry / EDITS) as aside:
            aside.write_bytes(data)
    studio.stream.library_changed()
    return version_of(data)

"""The page that shows a capture in 3D, and the masks of its photos."""

from __future__ import annotations

import contextlib
import hashlib
import os
from http import HTTPStatus
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.contents import files_within
from gsplat_edu.studio.photo_masks import draw_on, mask_of
from gsplat_edu.studio.replies import act, fields
from gsplat_edu.studio.scene_routes import cached_page
from gsplat_edu.studio.state import Studio


def routes() -> list[BaseRoute]:
    """Return the routes; they come before those of `gsplat_edu.studio.scene_routes`."""
    return [
        act("/api/captures/{name}/page", "GET", _page),
        act("/api/captures/{name}/settle", "POST", _settle),
        act("/api/captures/{name}/notes", "GET", _notes),
        act("/api/captures/{name}/region", "GET", _region),
        act("/api/captures/{name}/region", "POST", _change_region),
        act("/api/captures/{name}/poses", "GET", _poses),
        act("/api/captures/{name}/poses", "POST", _choose_poses),
        act("/api/captures/{name}/mask", "GET", _mask),
        act("/api/captures/{name}/mask", "POST", _draw),
    ]


def _settle(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    return studio.uploads.settle(request.path_params["name"])


def _notes(studio: Studio, request: Request, body: Any) -> Any:  # noqa: ANN401
    entry = studio.library.entry("captures", request.path_params["name"])
    return studio.worker.ask("notes", capture=str(entry))


def _mask(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    entry = studio.library.entry("captures", request.path_params["name"])
    return mask_of(studio, entry, request.query_params.get("photo", ""))


def _draw(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    entry = studio.library.entry("captures", request.path_params["name"])
    given = fields(body, photo=str, shapes=list, version=str)
    return draw_on(studio, entry, given["photo"], given["shapes"], given["version"])


def _page(studio: Studio, request: Request, body: Any) -> Response:  # noqa: ANN401
    entry = studio.library.entry("captures", request.path_params["name"])
    task = {"capture": str(entry), "title": legible(entry.name)}
    return cached_page(studio, request, f"capture {entry} {_state(entry)}", "capture_page", task)


def _region(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    from gsplat_edu.data.region import document_of, read_region  # the server starts without NumPy

    try:
        region = read_region(studio.library.entry("captures", request.path_params["name"]))
    except DatasetError as error:
        raise RefusedError(str(error), HTTPStatus.UNPROCESSABLE_ENTITY) from None
    return {"region": None if region is None else document_of(region)}


def _change_region(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    from gsplat_edu.data.region import requested_region, write_region

    try:
        region = requested_region(body)
    except ArgumentError as error:
        raise RefusedError(str(error)) from None
    write_region(studio.library.entry("captures", request.path_params["name"]), region)
    studio.stream.library_changed()
    return {}


def _poses(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    from gsplat_edu.data.chosen_poses import CHOSEN, chosen_poses, pose_choices

    entry = studio.library.entry("captures", request.path_params["name"])
    files = [{"file": file, "program": program} for file, program in pose_choices(entry)]
    chosen, is_lost = None, False
    if (entry / CHOSEN).is_file():
        try:
            chosen = chosen_poses(entry).relative_to(entry).as_posix()
        except DatasetError:
            is_lost = True
    return {"files": files if len(files) > 1 or is_lost else [], "chosen": chosen, "lost": is_lost}


def _choose_poses(studio: Studio, request: Request, body: Any) -> dict[str, Any]:  # noqa: ANN401
    from gsplat_edu.data.chosen_poses import choose_poses

    entry = studio.library.entry("captures", request.path_params["name"])
    choose_poses(entry, fields(body, file=str)["file"] or None)
    studio.stream.library_changed()
    return {}


def _state(entry: Path) -> str:
    """Return a value that changes with any file of a capture: its poses, its photos and what it leaves out."""
    digest = hashlib.sha256()
    for name, file, _ in sorted(files_within(entry), key=lambda found: found[0]):
        with contextlib.suppress(FileNotFoundError):  # it has just been removed
            facts = file.stat()
            digest.update(os.fsencode(f"{name} {facts.st_size} {facts.st_mtime_ns}\n"))
    return digest.hexdigest()

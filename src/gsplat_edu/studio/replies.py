"""Common parts of the routes: checked bodies, JSON answers, and errors of one line."""

from __future__ import annotations

import email.utils
import os
from collections.abc import Awaitable, Callable, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from gsplat_edu.base.errors import SplatError
from gsplat_edu.base.files import described, unreadable
from gsplat_edu.base.reading import open_file, parse_json
from gsplat_edu.base.text import bounded, legible, shortened
from gsplat_edu.server.bodies import Json, content_length, drain
from gsplat_edu.server.refusal import RefusedError, conflict, not_found, too_large
from gsplat_edu.studio.spoken import spoken
from gsplat_edu.studio.state import Studio

MOST_JSON = 16 << 20
"""Bytes of a JSON body."""

Act = Callable[[Studio, Request, Any], Any]
"""A route: the studio, the request and its JSON body (None without one); returns what is sent as JSON, or an answer."""

CLOSE = {"Connection": "close"}
"""Header of an answer to a request whose body may not have been read to its end."""

FRAMED = {"Content-Security-Policy": "default-src 'none'; frame-ancestors 'self'"}
"""Header of a refusal: where the studio's page wanted to show a scene in a frame, the frame gets it."""


QUIET = "quiet"
"""Parameter of a GET: with the value 1, a refusal has the status 200, and its own one in the JSON. The page asks so for
what may not be there yet, because browsers log every other status as an error."""


def act(path: str, method: str, function: Act) -> Route:
    """Return a route whose function runs in a thread, after the JSON body was read."""

    async def endpoint(request: Request) -> Response:
        body = await json_body(request) if method in ("POST", "PUT", "PATCH") else None
        found = await run_in_threadpool(function, request.app.state.studio, request, body)
        return found if isinstance(found, Response) else Json(found)

    return Route(path, answered(endpoint), methods=[method])


def answered(endpoint: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
    """Turn errors of a route into answers with one line."""

    async def safe(request: Request) -> Response:
        try:
            return await endpoint(request)
        except RefusedError as error:
            line, status = str(error), error.status
        except SplatError as error:
            line, status = str(error), HTTPStatus.BAD_REQUEST
        except ClientDisconnect:
            return refusal("body: the browser closed the connection", HTTPStatus.BAD_REQUEST)
        except OSError as error:
            line, status = described(error), HTTPStatus.INTERNAL_SERVER_ERROR
        await drain(request, status)
        if request.method in ("GET", "HEAD") and request.query_params.get(QUIET) == "1":
            return Json({"error": line, "plain": spoken(line), "status": int(status)})
        return refusal(line, status)

    return safe


def refusal(line: str, status: HTTPStatus) -> JSONResponse:
    """Return an error as an answer: {"error": the line, "plain": the same for people}."""
    plain = bounded(legible(spoken(line)))
    return JSONResponse({"error": bounded(legible(line)), "plain": plain}, status, headers=CLOSE | FRAMED)


async def json_body(request: Request) -> Any:  # noqa: ANN401
    """Read a JSON body.

    Raises:
        RefusedError: it is too long, of another type, or not JSON.
    """
    length = content_length(request)
    if length == 0:
        return None
    if (length or 0) > MOST_JSON:
        raise too_large(f"body: has {length:,} bytes, but {MOST_JSON:,} are allowed")
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise RefusedError("body: has to be application/json", HTTPStatus.UNSUPPORTED_MEDIA_TYPE)
    pieces, size = [], 0
    async for piece in request.stream():
        size += len(piece)
        if size > MOST_JSON:
            raise too_large(f"body: has more than {MOST_JSON:,} bytes")
        pieces.append(piece)
    if not size:
        return None
    try:
        return parse_json(b"".join(pieces), strict=True)
    except ValueError as error:
        raise RefusedError(f"body: is not JSON ({str(error)[:80]})") from None


def entry_of(studio: Studio, request: Request) -> tuple[str, Path]:
    """Return kind and path of the entry that a route names.

    Raises:
        RefusedError: there is none.
    """
    kind = request.path_params["kind"]
    return kind, studio.library.entry(kind, request.path_params["name"])


def file_answer(
    request: Request, path: Path, media_type: str, *, download: str | None = None, version: str = ""
) -> Response:
    """Return a file, or 304 if the browser has this version.

    Args:
        request: The request, whose If-None-Match counts.
        path: The file.
        media_type: Its type; the server guesses nothing from name or contents.
        download: Name under which the browser saves it; None shows it.
        version: Text that its ETag is computed from; its size and time if empty.
    """
    try:
        with open_file(path) as file:  # only a regular file
            facts = os.fstat(file.fileno())
    except OSError as error:
        if path.exists():
            raise conflict(unreadable(path, error)) from None
        raise not_found(path.name) from None
    etag = f'"{version or f"{facts.st_mtime_ns:x}-{facts.st_size:x}"}"'
    headers = {"ETag": etag, "Cache-Control": "no-cache"}
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    if download is not None:
        quoted = email.utils.encode_rfc2231(legible(download), "utf-8")
        headers["Content-Disposition"] = f"attachment; filename*={quoted}"
    return FileResponse(path, headers=headers, media_type=media_type)


def fields(body: Any, **wanted: type) -> Mapping[str, Any]:  # noqa: ANN401
    """Check that a body is an object with exactly these fields.

    Raises:
        RefusedError: a field is missing, of another type or not known.
    """
    if not isinstance(body, dict):
        raise RefusedError("body: has to be an object")
    for name, kind in wanted.items():
        if not isinstance(body.get(name), kind):
            raise RefusedError(f"{name}: is missing, or not of type {kind.__name__}")
    if unknown := sorted(set(body) - set(wanted)):
        raise RefusedError(f"{shortened(unknown[0])}: is not known; see docs/STUDIO.md")
    return body

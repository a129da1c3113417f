"""The studio as an ASGI application: the page's files, and the API that docs/STUDIO.md describes."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from importlib.resources import files
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute

from gsplat_edu.base.constants import LOOPBACK, SIZED
from gsplat_edu.options.offers import questions
from gsplat_edu.server.guard import Guard
from gsplat_edu.server.patience import Patience
from gsplat_edu.server.refusal import not_found
from gsplat_edu.studio import (
    capture_routes,
    floater_routes,
    job_routes,
    library_routes,
    live_routes,
    run_routes,
    scene_routes,
)
from gsplat_edu.studio.replies import act, file_answer
from gsplat_edu.studio.state import Studio

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".glsl": "text/plain; charset=utf-8",
}
"""Types of the page's files."""

POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data: blob:",
        "media-src 'self' blob:",
        "connect-src 'self'",
        "worker-src 'self' blob:",
        "frame-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
"""Content-Security-Policy: no inline scripts or styles, nothing from elsewhere."""


def application(
    studio: Studio, token: str, host: str = LOOPBACK, cookie: str = "gsplat_edu_studio"
) -> Starlette:
    """Return the application.

    Args:
        studio: The library and its jobs.
        token: See `gsplat_edu.server.guard.Guard`.
        host: Address that the server listens on.
        cookie: See `Guard`.
    """

    @contextlib.asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        following = asyncio.create_task(studio.stream.follow(studio.queue))
        try:
            yield
        finally:
            following.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await following

    routes: list[BaseRoute] = [
        act("/", "GET", lambda studio, request, body: _web(request, "gsplat_edu.studio", "index.html")),
        act("/web/questions.js", "GET", lambda studio, request, body: _questions()),
        act("/web/{name}", "GET", lambda studio, request, body: _web(request, "gsplat_edu.studio")),
        # with the path that it has in the package, so that an import leads to the same file here and in node
        act("/viewer/web/{name}", "GET", lambda studio, request, body: _web(request, "gsplat_edu.viewer")),
        act("/base/web/{name}", "GET", lambda studio, request, body: _web(request, "gsplat_edu.base")),
        *job_routes.routes(),
        *live_routes.routes(),
        *run_routes.routes(),
        *capture_routes.routes(),
        *scene_routes.routes(),
        *floater_routes.routes(),
        *library_routes.routes(),
    ]
    guard = Middleware(Guard, host=host, policy=POLICY, token=token, cookie=cookie)
    patience = Middleware(Patience, seconds=studio.uploads.limits.stall)
    app = Starlette(routes=routes, middleware=[guard, patience], lifespan=lifespan)
    app.state.studio, app.state.host = studio, host
    return app


def _questions() -> Response:
    """Return what the page asks for a training and which exports have a size, as a module; the commands say so."""
    text = f"export const GROUPS = {json.dumps(questions('train'))};\nexport const SIZED = {json.dumps(SIZED)};\n"
    return Response(text, media_type=TYPES[".js"])


def _web(request: Request, package: str, name: str | None = None) -> Response:
    """Return a file of the page; only files that its folder lists are served."""
    name = request.path_params["name"] if name is None else name
    folder: Any = files(package) / "web"
    known = {entry.name for entry in folder.iterdir() if Path(entry.name).suffix in TYPES}
    if name not in known:
        raise not_found(str(name))
    return file_answer(request, Path(str(folder / name)), TYPES[Path(name).suffix])

"""Serve one page from memory, a fixed list of files, and the further addresses of a page that changes something."""

from __future__ import annotations

from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.base.text import bounded, legible
from gsplat_edu.server.guard import Guard
from gsplat_edu.server.patience import Patience
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.server.serving import PATIENCE, Server

TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".wasm": "application/wasm",
    ".webp": "image/webp",
}
"""Content types of files by suffix."""


class PageServer(Server):
    """Serves one page at `/`, the listed files at their addresses, and nothing else.

    A server without a token answers only requests whose Host names this computer; one with a token answers only its own
    page. See `gsplat_edu.server.guard`.

    Args:
        policy: Content-Security-Policy of the page, sent as a header; empty sends none.
        host: Address to listen on.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.
        token: Whether the page needs a token.

    Attributes:
        page: The page.
        policy: See above.
        served: Further files by address; only requests for exactly these addresses are answered.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """

    def __init__(
        self,
        policy: str = "",
        host: str = LOOPBACK,
        port: int = 0,
        names: tuple[str, str] = ("--host", "--port"),
        token: bool = False,
    ) -> None:
        super().__init__(host, port, names, token)
        self.policy = policy
        self.page = b""
        self.served: Mapping[str, Path] = {}

    def application(self) -> ASGIApp:
        """Return the application that answers with the page, its files and its further addresses."""
        routes = [
            Route("/", self._page, methods=["GET"]),
            *self.routes(),
            Route("/{path:path}", self._file, methods=["GET"]),
        ]
        handlers: dict[Any, Any] = {
            HTTPException: _no_route,
            RefusedError: _refused,
            ClientDisconnect: _left,
        }
        app = Starlette(routes=routes, exception_handlers=handlers)
        app.router.redirect_slashes = False
        policy = f"{self.policy}; frame-ancestors 'none'" if self.policy else ""
        return Guard(Patience(app, PATIENCE), self.host, policy, self.token, self.cookie)

    def routes(self) -> list[BaseRoute]:
        """Return the page's further addresses, for classes that have some."""
        return []

    def _page(self, request: Request) -> Response:
        return Response(self.page, media_type="text/html")

    def _file(self, request: Request) -> Response:
        try:
            path = self.served[request.scope["path"]]
            body = read_bytes(path)
        except (KeyError, OSError):
            raise HTTPException(HTTPStatus.NOT_FOUND) from None
        return Response(body, media_type=TYPES.get(path.suffix, "application/octet-stream"))


def _no_route(request: Request, error: HTTPException) -> Response:
    status = HTTPStatus(error.status_code)
    headers = {"Connection": "close"}
    if status is HTTPStatus.METHOD_NOT_ALLOWED:
        headers["Allow"] = ", ".join(sorted((error.headers or {})["Allow"].split(", ")))
    return PlainTextResponse(f"{status.value} {status.phrase}\n", status, headers)


def _refused(request: Request, error: RefusedError) -> Response:
    line = bounded(legible(str(error)))
    return PlainTextResponse(f"{line}\n", error.status, {"Connection": "close"})


def _left(request: Request, error: ClientDisconnect) -> Response:
    return PlainTextResponse("the browser closed the connection\n", HTTPStatus.BAD_REQUEST)

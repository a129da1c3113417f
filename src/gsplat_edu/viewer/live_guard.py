"""Access control for the live view: only its own page, with the URL's token, under a name of this computer.

viser serves anyone who connects, and browsers let any page open a WebSocket to any address. So each request for a file
or a WebSocket must pass three checks before viser sees it:

- Host names this computer (`gsplat_edu.viewer.serve.names_this_computer`); this prevents DNS rebinding.
- Origin, required for a WebSocket, has the same host and port: the page was served here.
- The token, random for each run, is in the URL or in the cookie set when the page was opened with it. viser's client
  drops the URL's query before it opens the WebSocket, so there the cookie carries the token.
"""

from __future__ import annotations

import functools
import http
import http.cookies
import secrets
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from gsplat_edu.errors import ArgumentError
from gsplat_edu.viewer.serve import REQUEST_SECONDS, names_this_computer

TOKEN_BYTES = 16
"""Random bytes of a token: 2^128 possibilities cannot be guessed."""

Process = Callable[[ServerConnection, Request], Response | None]


class Guard:
    """Checks requests to one server.

    Args:
        host: Address that the server listens on.
        port: Its port, which distinguishes its cookie from those of other servers on this computer.
    """

    def __init__(self, host: str, port: int) -> None:
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        self._host = host
        self._cookie = f"gsplat_edu_{port}"

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Install the guard in front of the WebSocket server that is started inside the context.

        Raises:
            ArgumentError: viser did not start one through the expected function of websockets, so nothing would be
                checked.
        """
        serve, started = websockets.asyncio.server.serve, []

        def guarded(*words: Any, process_request: Process | None = None, **options: Any) -> Any:  # noqa: ANN401
            started.append(options)
            process = functools.partial(self._process, process_request)
            options["open_timeout"] = REQUEST_SECONDS  # for the whole handshake
            return serve(*words, process_request=process, **options)

        websockets.asyncio.server.serve = guarded  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]
        if not started:
            raise ArgumentError(
                "--view: this version of viser cannot be guarded; install the one in constraints.txt, or omit --view"
            )

    def _process(
        self, process: Process | None, connection: ServerConnection, request: Request
    ) -> Response | None:
        """Reject a request, or let viser answer it."""
        if (fault := self._fault(request)) is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"403 Forbidden: {fault}\n")
        response = None if process is None else process(connection, request)
        if response is not None:
            response.headers["Cache-Control"] = "no-store"
            response.headers["Referrer-Policy"] = "no-referrer"  # the URL is a secret
            response.headers["Content-Security-Policy"] = "frame-ancestors 'none'"
            cookie = f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            response.headers["Set-Cookie"] = cookie
        return response

    def _fault(self, request: Request) -> str | None:
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or not names_this_computer(hosts[0], self._host):
            return "unknown host name for this server"
        own = {f"{scheme}://{hosts[0]}".lower() for scheme in ("http", "https")}  # https if a proxy adds it
        is_socket = "Upgrade" in request.headers
        if len(origins) > 1 or (is_socket and not origins) or not own.issuperset(map(str.lower, origins)):
            return "requests from other pages are not allowed"
        if not any(
            secrets.compare_digest(given.encode(), self.token.encode()) for given in self._given(request)
        ):
            return "open the URL that the training printed, including its token"
        return None

    def _given(self, request: Request) -> list[str]:
        """Return the tokens of a request, from its URL and its cookies."""
        query = urllib.parse.urlsplit(request.path).query
        given = urllib.parse.parse_qs(query).get("token", [])
        for header in request.headers.get_all("Cookie"):
            try:
                cookies = http.cookies.SimpleCookie(header)
            except http.cookies.CookieError:
                continue
            if self._cookie in cookies:
                given.append(cookies[self._cookie].value)
        return given

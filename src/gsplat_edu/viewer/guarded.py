"""A page server that changes files: it answers only requests that `gsplat_edu.viewer.guard` accepts."""

from __future__ import annotations

import http
import urllib.parse

from gsplat_edu.viewer.guard import Guard
from gsplat_edu.viewer.serve import PATIENCE, PageHandler, PageServer, _Request


class GuardedServer(PageServer):
    """Serves one page to browsers that have its token.

    Args:
        host: Address to listen on.
        port: Port; 0 picks a free one.
        policy: Content-Security-Policy of the page.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """

    def __init__(self, host: str, port: int, policy: str) -> None:
        super().__init__(b"", host, port, policy=policy)
        self.guard = Guard(host, self.server_port)

    @property
    def url(self) -> str:
        """The page's address, with the token."""
        return f"{super().url}?token={self.guard.token}"


class GuardedHandler(PageHandler):
    """Answers one request of a `GuardedServer`."""

    server: GuardedServer
    _known = False  # whether the request brought the token

    def _answer(self) -> bytes:
        if (fault := self._fault()) is not None:
            self._refuse(http.HTTPStatus.FORBIDDEN, fault)
            return b""
        self.path = urllib.parse.urlsplit(self.path).path
        return super()._answer()

    def end_headers(self) -> None:
        """Send the headers, with the cookie if the request brought the token."""
        if self._known:
            self.send_header("Set-Cookie", self.server.guard.cookie)
        self.send_header("Referrer-Policy", "no-referrer")  # the URL is a secret
        super().end_headers()

    def _fault(self) -> str | None:
        """Return why a request is refused; None if it is not."""
        fault = self.server.guard.fault(
            self.command, self.path, lambda name: self.headers.get_all(name) or []
        )
        self._known = fault is None
        return fault

    def _body(self, most: int) -> bytes | None:
        """Return the body of a request; refuse one without a length, a longer or an incomplete one, and return None.

        Args:
            most: Largest number of bytes.
        """
        length = self.headers.get("Content-Length", "")
        if not length.isascii() or not length.isdigit():
            self._refuse(http.HTTPStatus.LENGTH_REQUIRED, "the length is missing")
            return None
        if int(length) > most:
            self._refuse(http.HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {most:,} bytes")
            return None
        raw = self.rfile.raw  # type: ignore[attr-defined]
        if isinstance(raw, _Request):
            raw.allow(PATIENCE, int(length) + 1)
        data = self.rfile.read(int(length))
        if len(data) != int(length):
            self._refuse(http.HTTPStatus.BAD_REQUEST, "the request is incomplete")
            return None
        return data

    def _refuse(self, status: http.HTTPStatus, reason: str) -> None:
        self.send_response(status)
        self._text(reason)

    def _text(self, text: str) -> None:
        body = f"{text}\n".encode("utf-8", "replace")
        self._headers("text/plain; charset=utf-8", len(body))
        if self.command != "HEAD":
            self.wfile.write(body)

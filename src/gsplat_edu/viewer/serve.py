"""Serve one page from memory, and a fixed list of files, to browsers on this computer."""

from __future__ import annotations

import http
import io
import os
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.server.address import checked_address, names_this_computer, refused_address, url_of

TYPES = {".json": "application/json", ".webp": "image/webp"}
"""Content types of files by suffix."""

CHUNK = 1 << 20
"""Bytes per write. The time limit holds for each chunk, not for a page of many MB."""

PATIENCE = 30.0
"""Seconds allowed for each chunk of the page."""

REQUEST_SECONDS = 10.0
"""Time limit for a whole request, s, even if bytes keep trickling in."""

REQUEST_BYTES = 64 << 10
"""Longest request. Browsers send one or two KB; bodies are never read."""

MOST_CONNECTIONS = 128
"""Largest number of open connections, each with a thread. Further ones are closed without an answer."""


class PageServer(ThreadingHTTPServer):
    """Serves one page at `/`, the listed files at their addresses, and nothing else.

    It accepts connections once created; `serve_forever` answers them. A server bound to a loopback address answers only
    requests whose Host names this computer. Otherwise an external page could let its own name resolve to this address
    and read the page (DNS rebinding). A server bound to another address also answers requests that name an address or a
    name that only a local network can assign.

    A request must arrive within `REQUEST_SECONDS` and `REQUEST_BYTES`; otherwise its connection is closed.

    Args:
        page: The page.
        host: Address to listen on.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.
        policy: Content-Security-Policy of the page, also sent as a header; empty sends none.
        served: Further files by address; only requests for exactly these addresses are answered.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """

    daemon_threads = True
    allow_reuse_address = os.name == "posix"  # on Windows it would let two servers share a port

    def __init__(
        self,
        page: bytes,
        host: str = LOOPBACK,
        port: int = 0,
        names: tuple[str, str] = ("--host", "--port"),
        policy: str = "",
        served: Mapping[str, Path] | None = None,
    ) -> None:
        self.page, self.policy = page, policy
        self.served = dict(served or {})
        self.bound_host = host
        self._room = threading.Semaphore(MOST_CONNECTIONS)
        self.address_family, address = checked_address(host, port, names)
        try:
            super().__init__(address, PageHandler)
        except OSError as error:
            raise refused_address(host, port, names, error) from None

    @property
    def url(self) -> str:
        """The page's address."""
        return url_of(str(self.server_address[0]), self.server_port)

    def server_bind(self) -> None:
        """Bind without looking up this computer's name on the network."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Serve a connection in its own thread, or close it if there are too many."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Serve a connection in its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Ignore errors: only connections that were closed or cut off can fail."""


class _Request(io.RawIOBase):
    """The bytes of one request from a socket, limited in time and number.

    A time limit per read would not suffice: a client could send a byte now and then and hold its thread forever.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._until = time.monotonic() + REQUEST_SECONDS
        self._room = REQUEST_BYTES

    def allow(self, seconds: float, count: int) -> None:
        """Give the rest of the request this time and number of bytes."""
        self._until, self._room = time.monotonic() + seconds, count

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:  # noqa: ANN401
        left = self._until - time.monotonic()
        if left <= 0 or self._room <= 0:
            raise TimeoutError
        self._connection.settimeout(left)
        count = self._connection.recv_into(buffer)
        self._room -= count
        return count


class PageHandler(BaseHTTPRequestHandler):
    """Answers one request of a `PageServer`."""

    server: PageServer
    server_version, sys_version = "gsplat-edu", ""

    def setup(self) -> None:
        """Limit the request in time and size."""
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(_Request(self.connection))

    def __getattr__(self, name: str) -> Callable[[], None]:
        # http.server looks up do_METHOD; a missing one means that the method is not allowed
        if name.startswith("do_"):
            return lambda: self._say(http.HTTPStatus.METHOD_NOT_ALLOWED)
        raise AttributeError(name)

    def do_HEAD(self) -> None:
        """Answer with the headers only."""
        self._answer()

    def do_GET(self) -> None:
        """Answer with the page or a file."""
        body = memoryview(self._answer())
        for begin in range(0, len(body), CHUNK):
            self.wfile.write(body[begin : begin + CHUNK])

    def _answer(self) -> bytes:
        """Send the headers of the page or a file and return its bytes, or send an error and return nothing."""
        if not self._is_for_us():
            self._say(http.HTTPStatus.FORBIDDEN)
            return b""
        if self.path == "/":
            body, kind = self.server.page, "text/html; charset=utf-8"
        else:
            try:
                body = read_bytes(self.server.served[self.path])
            except (KeyError, OSError):
                self._say(http.HTTPStatus.NOT_FOUND)
                return b""
            kind = TYPES.get(self.server.served[self.path].suffix, "application/octet-stream")
        self.send_response(http.HTTPStatus.OK)
        if self.server.policy:
            self.send_header("Content-Security-Policy", f"{self.server.policy}; frame-ancestors 'none'")
        self._headers(kind, len(body))
        return body

    def _is_for_us(self) -> bool:
        """Return whether the request names this computer."""
        hosts = self.headers.get_all("Host") or []
        return len(hosts) == 1 and names_this_computer(hosts[0], self.server.bound_host)

    def _say(self, status: http.HTTPStatus) -> None:
        text = f"{status.value} {status.phrase}\n".encode("ascii")
        self.send_response(status)
        if status is http.HTTPStatus.METHOD_NOT_ALLOWED:
            self.send_header("Allow", "GET, HEAD")
        self._headers("text/plain; charset=utf-8", len(text))
        if self.command != "HEAD":
            self.wfile.write(text)

    def _headers(self, kind: str, length: int) -> None:
        self.connection.settimeout(PATIENCE)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, ANN401
        """Keep the terminal clean."""

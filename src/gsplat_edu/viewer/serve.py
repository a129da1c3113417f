"""Serve one page from memory, and a fixed list of files, to browsers on this computer."""

from __future__ import annotations

import errno
import http
import io
import ipaddress
import os
import re
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.base.validation import whole_number

PORT = 8080
"""Default port of a page."""

LOCAL_NAME = r"(?:127(?:\.\d{1,3}){3}|localhost|\[::1\])(?::\d+)?"
"""Names by which a browser on this computer addresses it, as a regular expression; a tunnel may change the port."""

HIGHEST_PORT = 65_535

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

PRIVATE_SUFFIXES = (".local", ".localdomain", ".lan", ".home", ".home.arpa", ".internal")
"""Suffixes of names that only a local network can assign; no external page can have such a name."""


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
            raise _refusal(host, port, names, error) from None

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


def checked_address(
    host: str, port: int, names: tuple[str, str]
) -> tuple[socket.AddressFamily, tuple[Any, ...]]:
    """Convert host and port to the address of a socket.

    Args:
        host: Name or address.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.

    Returns:
        The address family and the address.

    Raises:
        ArgumentError: the host cannot be resolved, or the port is out of range.
    """
    port = whole_number(names[1], port, 0, HIGHEST_PORT)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):  # names without letters, or too long, fail in their encoding
        raise ArgumentError(
            f"{names[0]}: {host!r} is not an address; give {LOOPBACK} or an address of this computer"
        ) from None
    family, _, _, _, address = found[0]
    return family, address


def bound_socket(host: str, port: int, names: tuple[str, str]) -> socket.socket:
    """Return a socket that is bound to an address, for servers that take one.

    Args:
        host: Name or address.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """
    family, address = checked_address(host, port, names)
    bound = socket.socket(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # a port whose last connections are closing counts as free
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen()
    except OSError as error:
        bound.close()
        raise _refusal(host, port, names, error) from None
    return bound


def free_port(host: str, port: int, names: tuple[str, str]) -> int:
    """Check that a port is available, for servers that do not report it themselves.

    Args:
        host: Name or address.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.

    Returns:
        The port, or a free one if `port` is 0.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """
    family, address = checked_address(host, port, names)
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        if os.name == "posix":  # like a server: a port whose last connections are closing counts as free
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
            probe.listen(1)
        except OSError as error:
            raise _refusal(host, port, names, error) from None
        return int(probe.getsockname()[1])


def names_this_computer(header: str, bound: str) -> bool:
    """Return whether a Host header names this computer in a way that no external page could arrange.

    The owner of a name in the public DNS can let it resolve to any address; a page under that name would then share the
    origin of this server. Addresses and names outside the public DNS are safe.

    Args:
        header: Value of the header: a name or address, with an optional port.
        bound: Address that the server is bound to. If it is a loopback address, names of other computers are rejected.
    """
    if re.fullmatch(LOCAL_NAME, header, re.IGNORECASE):
        return True
    found = re.fullmatch(r"(\[[0-9a-f:.]+\]|[a-z0-9_.-]+)(?::\d{1,5})?", header.lower())
    if found is None or is_loopback(bound):
        return False
    name = found[1].removesuffix(".")
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        known = {bound.lower(), socket.gethostname().lower()}
        return "." not in name or name in known or name.endswith(PRIVATE_SUFFIXES)
    return True


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached only from this computer."""
    return re.fullmatch(rf"{LOCAL_NAME}|::1", host, re.I) is not None


def url_of(host: str, port: int) -> str:
    """Return the URL of a page served on this computer."""
    if host in ("0.0.0.0", "::"):  # all addresses of this computer
        host = LOOPBACK if host == "0.0.0.0" else "::1"
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def exposure(host: str, what: str, token: bool = False) -> str | None:
    """Return a warning if other computers can reach a server; None if only this one can.

    Args:
        host: Address that the server listens on.
        what: What other computers can do with the server, as a verb phrase.
        token: Whether the server requires the token in its URL.
    """
    if is_loopback(host):
        return None
    if token:
        who = "anyone who can reach this computer and has the URL"
        return f"warning: listening on {host}: {who} {what}; the connection is not encrypted"
    return f"warning: listening on {host}: anyone who can reach this computer {what}; there is no password"


def _refusal(host: str, port: int, names: tuple[str, str], error: OSError) -> ArgumentError:
    if error.errno == errno.EADDRINUSE:
        return ArgumentError(
            f"{names[1]}: {port} is in use on {host}; choose another port, or 0 for any free one"
        )
    if error.errno == errno.EACCES:
        return ArgumentError(f"{names[1]}: {port} is not permitted ({error.strerror}); choose one above 1023")
    return ArgumentError(
        f"{names[0]}: cannot listen on {host} ({error.strerror}); give {LOOPBACK} or omit the option"
    )

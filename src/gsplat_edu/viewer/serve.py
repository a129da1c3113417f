"""One page, served from memory to browsers on this computer. No file can be reached through the server."""

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
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from gsplat_edu.errors import ArgumentError
from gsplat_edu.validation import whole_number

LOOPBACK = "127.0.0.1"

LOCAL_NAME = r"(?:127(?:\.\d{1,3}){3}|localhost|\[::1\])(?::\d+)?"
"""How a browser on this computer names it, as a regular expression; the port may be that of a tunnel."""

HIGHEST_PORT = 65_535

CHUNK = 1 << 20
"""Bytes written at a time: the time limit is for each of them, not for a page of many MB."""

PATIENCE = 30.0
"""Seconds that a browser may take for each chunk of the page."""

REQUEST_SECONDS = 10.0
"""Seconds in which a whole request has to arrive, however it trickles in."""

REQUEST_BYTES = 64 << 10
"""Longest request. Browsers send one or two KB; bodies are not read at all."""

MOST_CONNECTIONS = 128
"""Connections, each with a thread, that are served at once. More are closed unanswered."""

PRIVATE_SUFFIXES = (".local", ".localdomain", ".lan", ".home", ".home.arpa", ".internal")
"""How names end that only a local network can give: no page from elsewhere can have one."""


class PageServer(ThreadingHTTPServer):
    """Serves one page at `/`, and nothing else.

    It takes connections from the moment it is made; `serve_forever` answers them. Bound to this computer, it answers
    only requests that name this computer as their host: otherwise a page from elsewhere could have its own name point
    here, and read what is served (DNS rebinding). Bound to other addresses, it answers those that name an address, this
    computer, or a name that only a local network can give.

    A request has to arrive within `REQUEST_SECONDS` and `REQUEST_BYTES`, or its connection is closed.

    Args:
        page: The page.
        host: Address to listen at.
        port: Port; 0 for any that is free.
        names: What the user calls host and port, for messages.
        policy: Content-Security-Policy of the page, sent as a header too; none where empty.

    Raises:
        ArgumentError: the address is none of this computer's, or the port is taken or out of range.
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
    ) -> None:
        self.page, self.policy = page, policy
        self.bound_host = host
        self._room = threading.Semaphore(MOST_CONNECTIONS)
        self.address_family, address = checked_address(host, port, names)
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            raise _refusal(host, port, names, error) from None

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return url_of(str(self.server_address[0]), self.server_port)

    def server_bind(self) -> None:
        """Bind, without asking the network for the name of this computer."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Serve a connection in a thread of its own, or close it where there are too many."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Serve a connection, in its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Say nothing: all that can fail is a connection that the browser has closed, or that was cut off."""


class _Request(io.RawIOBase):
    """The bytes of one request, from a socket, within limits on their time and number.

    A time limit on each read would let a client send a byte now and then, and hold its thread for ever.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._until = time.monotonic() + REQUEST_SECONDS
        self._room = REQUEST_BYTES

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


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    server_version, sys_version = "gsplat-edu", ""

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self.rfile = io.BufferedReader(_Request(self.connection))

    def __getattr__(self, name: str) -> Callable[[], None]:
        # http.server looks for do_METHOD: whatever has none here is a method that is not allowed
        if name.startswith("do_"):
            return lambda: self._say(http.HTTPStatus.METHOD_NOT_ALLOWED)
        raise AttributeError(name)

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        if self._answer():
            page = memoryview(self.server.page)
            for begin in range(0, len(page), CHUNK):
                self.wfile.write(page[begin : begin + CHUNK])

    def _answer(self) -> bool:
        """Send the headers of the page and say so; else those that say why not."""
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1 or not names_this_computer(hosts[0], self.server.bound_host):
            self._say(http.HTTPStatus.FORBIDDEN)
            return False
        if self.path != "/":
            self._say(http.HTTPStatus.NOT_FOUND)
            return False
        self.send_response(http.HTTPStatus.OK)
        if self.server.policy:
            self.send_header("Content-Security-Policy", f"{self.server.policy}; frame-ancestors 'none'")
        self._headers("text/html; charset=utf-8", len(self.server.page))
        return True

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
    """Turn host and port into what a socket is bound to.

    Args:
        host: Name or address.
        port: Port; 0 for any that is free.
        names: What the user calls the two, for messages.

    Returns:
        The family of the address, and the address.

    Raises:
        ArgumentError: the host has no address, or the port is out of range.
    """
    port = whole_number(names[1], port, 0, HIGHEST_PORT)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):  # names of no letters, or too many, fail in their encoding
        raise ArgumentError(
            f"{names[0]}: {host!r} is no address; give {LOOPBACK}, or one of this computer's"
        ) from None
    family, _, _, _, address = found[0]
    return family, address


def free_port(host: str, port: int, names: tuple[str, str]) -> int:
    """Find out whether a port can be listened at, for servers that do not say it when it cannot.

    Args:
        host: Name or address.
        port: Port; 0 for any that is free.
        names: What the user calls the two, for messages.

    Returns:
        The port, or one that is free.

    Raises:
        ArgumentError: the address is none of this computer's, or the port is taken or out of range.
    """
    family, address = checked_address(host, port, names)
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        if (
            os.name == "posix"
        ):  # as servers do it: a port whose last connections are just being closed is free
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
            probe.listen(1)
        except OSError as error:
            raise _refusal(host, port, names, error) from None
        return int(probe.getsockname()[1])


def names_this_computer(header: str, bound: str) -> bool:
    """Say whether a Host header names this computer in a way that no page from elsewhere could arrange.

    A page whose name is in the public DNS can have that name point to any address, and would then share the origin of
    what is served there. It cannot do so with an address, nor with a name outside the public DNS.

    Args:
        header: Value of the header: a name or address, and a port or none.
        bound: What the server was told to listen at. Names of other computers are turned away where it is a loopback
            address.
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
    """Say whether only this computer can reach what listens at a host."""
    return re.fullmatch(rf"{LOCAL_NAME}|::1", host, re.I) is not None


def url_of(host: str, port: int) -> str:
    """Return the URL of a page on this computer that is served at a host and port."""
    if host in ("0.0.0.0", "::"):  # every address of this computer
        host = LOOPBACK if host == "0.0.0.0" else "::1"
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def exposure(host: str, what: str, token: bool = False) -> str | None:
    """Return the sentence that warns of a server which others can reach; None where only this computer can.

    Args:
        host: Where it listens.
        what: What it lets them do.
        token: Whether its URL has a token, without which it answers nobody.
    """
    if is_loopback(host):
        return None
    if token:
        who = "whoever can reach this computer and has the URL"
        return f"warning: listening at {host}: {who} {what}; the connection is not encrypted"
    return f"warning: listening at {host}: whoever can reach this computer {what}; there is no password"


def _refusal(host: str, port: int, names: tuple[str, str], error: OSError) -> ArgumentError:
    if error.errno == errno.EADDRINUSE:
        return ArgumentError(
            f"{names[1]}: {port} is taken on {host}; give another, or 0 for any that is free"
        )
    if error.errno == errno.EACCES:
        return ArgumentError(f"{names[1]}: {port} may not be used ({error.strerror}); give one above 1023")
    return ArgumentError(
        f"{names[0]}: cannot listen at {host} ({error.strerror}); give {LOOPBACK}, or leave it out"
    )

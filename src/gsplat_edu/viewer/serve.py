"""One page, served from memory to browsers on this computer. No file can be reached through the server."""

from __future__ import annotations

import errno
import http
import os
import re
import socket
import socketserver
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
"""Seconds after which a connection that neither sends nor takes anything is closed."""


class PageServer(ThreadingHTTPServer):
    """Serves one page at `/`, and nothing else.

    It takes connections from the moment it is made; `serve_forever` answers them. Bound to this computer, it answers
    only requests that name this computer as their host: otherwise a page from elsewhere could have its own name point
    here, and read what is served.

    Args:
        page: The page.
        host: Address to listen at.
        port: Port; 0 for any that is free.
        names: What the user calls host and port, for messages.

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
    ) -> None:
        self.page = page
        self.address_family, address = checked_address(host, port, names)
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            raise _refusal(host, port, names, error) from None
        self.local_only = is_loopback(host)

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return url_of(str(self.server_address[0]), self.server_port)

    def server_bind(self) -> None:
        """Bind, without asking the network for the name of this computer."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Say nothing: all that can fail is a connection that the browser has closed."""


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    server_version, sys_version = "gsplat-edu", ""
    timeout = PATIENCE

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
        if self.server.local_only and (len(hosts) != 1 or not re.fullmatch(LOCAL_NAME, hosts[0], re.I)):
            self._say(http.HTTPStatus.FORBIDDEN)
            return False
        if self.path != "/":
            self._say(http.HTTPStatus.NOT_FOUND)
            return False
        self.send_response(http.HTTPStatus.OK)
        self._headers("text/html; charset=utf-8", len(self.server.page))
        return True

    def _say(self, status: http.HTTPStatus) -> None:
        text = f"{status.value} {status.phrase}\n".encode()
        self.send_response(status)
        if status is http.HTTPStatus.METHOD_NOT_ALLOWED:
            self.send_header("Allow", "GET, HEAD")
        self._headers("text/plain; charset=utf-8", len(text))
        if self.command != "HEAD":
            self.wfile.write(text)

    def _headers(self, kind: str, length: int) -> None:
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
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


def is_loopback(host: str) -> bool:
    """Say whether only this computer can reach what listens at a host."""
    return re.fullmatch(rf"{LOCAL_NAME}|::1", host, re.I) is not None


def url_of(host: str, port: int) -> str:
    """Return the URL of a page on this computer that is served at a host and port."""
    if host in ("0.0.0.0", "::"):  # every address of this computer
        host = LOOPBACK if host == "0.0.0.0" else "::1"
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def exposure(host: str, what: str) -> str | None:
    """Return the sentence that warns of a server which others can reach; None where only this computer can.

    Args:
        host: Where it listens.
        what: What it lets them do.
    """
    if is_loopback(host):
        return None
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

"""Serve an ASGI application with limits of time, size and number, in the foreground or in a thread of its own.

A connection is closed if the head of its request takes longer than `REQUEST_SECONDS` or is longer than `REQUEST_BYTES`,
and if its browser takes longer than `PATIENCE` to read a part of an answer. The application itself limits bodies
(`gsplat_edu.server.patience`).
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Any, TypeVar

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.server.address import bound_socket, url_of

LOG = logging.getLogger("uvicorn.error")
"""uvicorn's log of errors, which goes to the terminal."""

LOG.setLevel(logging.ERROR)  # not a line for each request that is no HTTP

TOKEN_BYTES = 16
"""Random bytes of a token: 2^128 possibilities cannot be guessed."""

REQUEST_SECONDS = 10.0
"""Time limit for the whole head of a request, s, even if bytes keep trickling in."""

REQUEST_BYTES = 64 << 10
"""Longest head of a request. Browsers send one or two KB."""

PATIENCE = 30.0
"""Seconds in which a browser has to read a part of an answer (`gsplat_edu.server.patience.CHUNK`)."""

MOST_CONNECTIONS = 256
"""Connections that are served at once; further ones are closed without an answer."""

KEEP_ALIVE = 30
"""Seconds that an idle connection of the page stays open."""

GRACEFUL = 2
"""Seconds that running requests get to end when the server stops."""

Own = TypeVar("Own")
"""The class of a server."""


def _is_fault(record: logging.LogRecord) -> bool:
    """Return whether a record is about a fault, and not about a request that the server's end has cut off."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, asyncio.CancelledError) and not record.getMessage().startswith("Cancel ")


LOG.addFilter(_is_fault)


class Server:
    """Listens on an address once created, so that a port in use is reported at once; answers when run or started.

    Args:
        host: Address to listen on.
        port: Port; 0 picks a free one.
        names: The user's names for host and port, for messages.
        token: Whether the page needs a token; see `gsplat_edu.server.guard`.

    Attributes:
        host: The address, as given.
        port: The port.
        token: The token, random; empty without one.
        cookie: Name of the cookie that holds it.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """

    def __init__(
        self,
        host: str = LOOPBACK,
        port: int = 0,
        names: tuple[str, str] = ("--host", "--port"),
        token: bool = False,
    ) -> None:
        self.host = host
        self._socket = bound_socket(host, port, names)
        self._address = str(self._socket.getsockname()[0])
        self.port = int(self._socket.getsockname()[1])
        self.token = secrets.token_urlsafe(TOKEN_BYTES) if token else ""
        self.cookie = f"gsplat_edu_{self.port}"
        self._server: _Uvicorn | None = None
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """The page's address, with the token if there is one."""
        return url_of(self._address, self.port) + (f"?token={self.token}" if self.token else "")

    def run(self, app: ASGIApp, ready: Callable[[], None], ending: Callable[[], None] | None = None) -> None:
        """Answer until Ctrl-C, which raises KeyboardInterrupt in the end.

        Args:
            app: The application.
            ready: Called once it answers.
            ending: Called in its event loop before the running requests get their time to end.
        """
        _Uvicorn(app, ready, ending).run(sockets=[self._socket])

    def start(self, app: ASGIApp, ending: Callable[[], None] | None = None) -> None:
        """Answer from a thread of its own until `stop`; returns once it answers.

        Args:
            app: The application.
            ending: As for `run`.

        Raises:
            RuntimeError: it ended before it answered, because the application did not start.
        """
        ready = threading.Event()
        server = self._server = _Uvicorn(app, ready.set, ending)

        def answer() -> None:
            try:
                server.run(sockets=[self._socket])
            finally:
                ready.set()

        self._thread = threading.Thread(target=answer, name="server", daemon=True)
        self._thread.start()
        ready.wait()
        if not server.started:
            raise RuntimeError("the server ended before it answered")

    def stop(self) -> None:
        """Stop answering, if it was started, and stop listening."""
        if self._server is not None and self._thread is not None:
            self._server.should_exit = True
            self._thread.join()
            self._server = self._thread = None
        self._socket.close()

    def __enter__(self: Own) -> Own:
        """Return the server, which stops at the end of the block."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop."""
        self.stop()


class PatientProtocol(H11Protocol):
    """uvicorn's protocol with time limits for the whole head of a request and for reading the answer."""

    _late: asyncio.TimerHandle | None = None
    _unread: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401
        """Accept a connection, or close it if there are too many."""
        if len(self.connections) >= MOST_CONNECTIONS:
            transport.close()
        super().connection_made(transport)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self._heard()
        self._was_read()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Receive bytes."""
        super().data_received(data)
        if self.conn.their_state is h11.IDLE and self.conn.trailing_data[0]:
            self._wait()  # the head of the next request has begun
        else:
            self._heard()

    def pause_writing(self) -> None:
        """Wait until the browser has read what was written."""
        super().pause_writing()
        if self._unread is None:
            self._unread = self.loop.call_later(PATIENCE, self.transport.abort)

    def resume_writing(self) -> None:
        """Write on."""
        self._was_read()
        super().resume_writing()

    def on_response_complete(self) -> None:
        """Close a connection whose request was answered before its body arrived, because nothing reads the rest."""
        super().on_response_complete()
        if self.conn.their_state is h11.SEND_BODY and not self.transport.is_closing():
            self.transport.close()

    def _wait(self) -> None:
        if self._late is None:
            self._late = self.loop.call_later(REQUEST_SECONDS, self._close)

    def _heard(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None

    def _was_read(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _close(self) -> None:
        if not self.transport.is_closing():
            self.transport.close()


class _Uvicorn(uvicorn.Server):
    """uvicorn with our limits, and callbacks: once it listens, and before it waits for its connections to end."""

    def __init__(
        self, app: ASGIApp, ready: Callable[[], None], ending: Callable[[], None] | None = None
    ) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http=PatientProtocol,
                ws="none",
                loop="asyncio",
                lifespan="on",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=False,
                timeout_keep_alive=KEEP_ALIVE,
                timeout_graceful_shutdown=GRACEFUL,
                h11_max_incomplete_event_size=REQUEST_BYTES,
            )
        )
        self._ready, self._ending = ready, ending

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen."""
        await super().startup(sockets)
        self._ready()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the connections."""
        if self._ending is not None:
            self._ending()
        await super().shutdown(sockets)

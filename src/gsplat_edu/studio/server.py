"""Serve the studio: one process, one event loop, and time limits for idle connections."""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from gsplat_edu.base.locks import locked
from gsplat_edu.studio.app import application
from gsplat_edu.studio.library import HIDDEN, check_own_folders
from gsplat_edu.studio.state import Studio
from gsplat_edu.studio.uploads import Limits
from gsplat_edu.viewer.guard import TOKEN_BYTES
from gsplat_edu.viewer.serve import REQUEST_BYTES, REQUEST_SECONDS, bound_socket, url_of

logging.getLogger("uvicorn.error").setLevel(logging.ERROR)  # not a line for each request that is no HTTP

MOST_CONNECTIONS = 256
"""Connections that are served at once; further ones are closed without an answer."""

KEEP_ALIVE = 30
"""Seconds that an idle connection of the page stays open."""


class PatientProtocol(H11Protocol):
    """uvicorn's protocol with a time limit for the whole head of a request, even if bytes keep trickling in."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:  # noqa: ANN401
        """Accept a connection, or close it if there are too many."""
        if len(self.connections) >= MOST_CONNECTIONS:
            transport.close()
        super().connection_made(transport)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget a connection."""
        self._heard()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Receive bytes."""
        super().data_received(data)
        if self.conn.their_state is h11.IDLE and self.conn.trailing_data[0]:
            self._wait()  # the head of the next request has begun
        else:
            self._heard()

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

    def _close(self) -> None:
        if not self.transport.is_closing():
            self.transport.close()


def serve(
    folder: Path,
    host: str,
    port: int,
    at_once: int,
    limits: Limits,
    say: Callable[[str], None],
    opened: Callable[[str], None],
) -> None:
    """Serve a library until Ctrl-C; running jobs then end with a checkpoint, and the next start holds waiting ones.

    Args:
        folder: The library's folder.
        host: Address to listen on.
        port: Port; 0 for any free one.
        at_once: Jobs that run at the same time.
        limits: How much may be taken in.
        say: Prints a line.
        opened: Called with the page's URL once it can be opened.

    Raises:
        ArgumentError: the address cannot be used, another server has the folder, or its own folders are links.
    """
    check_own_folders(folder)
    with (
        bound_socket(host, port, ("--host", "--port")) as sock,
        locked("FOLDER", folder / HIDDEN, "gsplat-edu studio", say),
    ):
        token = secrets.token_urlsafe(TOKEN_BYTES)
        number = int(sock.getsockname()[1])
        studio = Studio(folder, at_once, limits)
        try:
            app = application(studio, token, host, f"gsplat_edu_studio_{number}")
            url = f"{url_of(host, number)}?token={token}"
            server = _Server(_config(app), lambda: opened(url), studio.stream.close)
            server.run(sockets=[sock])
        finally:
            if any(job.pid for job in studio.queue.jobs()):
                say("ending the running jobs; a training writes a checkpoint first")
            studio.close()


def _config(app: Any) -> uvicorn.Config:  # noqa: ANN401
    return uvicorn.Config(
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
        timeout_graceful_shutdown=2,
        h11_max_incomplete_event_size=REQUEST_BYTES,
    )


class _Server(uvicorn.Server):
    """A server with callbacks: once it listens, and before it waits for its connections to end."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None], ending: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready, self._ending = ready, ending

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to listen."""
        await super().startup(sockets)
        self._ready()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the connections."""
        self._ending()
        await super().shutdown(sockets)

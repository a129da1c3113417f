"""Serve a page with the editor, and write the edits file that it sends.

`gsplat_edu.server.guard` checks every request. A write is refused unless the page has the newest version of the file,
because another tab or program may have written it.
"""

from __future__ import annotations

import threading
from http import HTTPStatus
from pathlib import Path

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from gsplat_edu.base.errors import ArgumentError, SplatError
from gsplat_edu.base.files import described, written_aside
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.stored import MOST_BYTES, version_of
from gsplat_edu.server.bodies import Json, body_of
from gsplat_edu.server.page_server import PageServer
from gsplat_edu.server.refusal import RefusedError, conflict
from gsplat_edu.viewer.edit_page import read_content
from gsplat_edu.viewer.proposing import NAME, Proposing

ADDRESS = "/edits.json"
"""Where the page reads and writes its edits."""

FLOATERS = f"/{NAME}"
"""Where the page asks for splats to delete."""


class EditServer(PageServer):
    """Serves one page with the editor, to browsers that have its token.

    Args:
        host: Address to listen on.
        port: Port; 0 picks a free one.
        policy: Content-Security-Policy of the page.
        file: The edits file to write.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """

    def __init__(self, host: str, port: int, policy: str, file: Path) -> None:
        super().__init__(policy, host, port, token=True)
        self.file = file
        self.scene: Identity | None = None
        self.writing = threading.Lock()
        self.proposing: Proposing | None = None

    def prepare(self, scene: Identity, source: Path | None = None) -> None:
        """Set the scene that is edited, and check the file if it exists.

        Args:
            scene: Its identity.
            source: Scene file or run folder that proposals are made for; None for no proposals.

        Raises:
            ArgumentError: the file is damaged, or was made for another scene.
            OSError: it cannot be read.
        """
        self.scene = scene
        self.proposing = None if source is None else Proposing(source)
        self.content()

    def stop(self) -> None:
        """Stop the server, and end the process that judges the scene."""
        super().stop()
        if self.proposing is not None:
            self.proposing.stop()

    def content(self) -> bytes | None:
        """Return the checked content of the file; None if there is none.

        Raises:
            ArgumentError: it is damaged, or was made for another scene.
            OSError: it cannot be read.
        """
        data = read_content(self.file)
        if data is not None:
            self._check(data)
        return data

    def _check(self, data: bytes) -> None:
        edits = parse_edits(data, self.file.name)
        if self.scene is not None:
            edits.check_scene(self.scene, self.file.name)

    def store(self, data: bytes, expected: str) -> str | None:
        """Write the file and return its new version; return None if its version is not the expected one.

        Raises:
            ArgumentError: the data is no valid edits file of this scene.
            OSError: the file cannot be written. An existing file stays unchanged.
        """
        self._check(data)
        with self.writing:
            if version_of(read_content(self.file)) != expected:
                return None
            with written_aside(self.file) as aside:
                aside.write_bytes(data)
        return version_of(data)

    def routes(self) -> list[BaseRoute]:
        """Return the addresses of the edits and of the proposals."""
        return [
            Route(ADDRESS, self._answer_edits, methods=["GET", "PUT"]),
            Route(FLOATERS, self._answer_proposals, methods=["GET", "POST", "DELETE"]),
        ]

    async def _answer_edits(self, request: Request) -> Response:
        if request.method != "PUT":
            return await run_in_threadpool(self._send)
        expected = request.headers.get("If-Match", "").strip('"')
        data = await body_of(request, MOST_BYTES)
        return await run_in_threadpool(self._save, data, expected)

    def _send(self) -> Response:
        """Answer with the edits file, or refuse one that the page could not apply."""
        try:
            data = self.content()
        except (SplatError, OSError) as error:
            reason = described(error) if isinstance(error, OSError) else str(error)
            raise conflict(reason) from None
        headers = {"ETag": f'"{version_of(data)}"'}
        return Response(b"null\n" if data is None else data, headers=headers, media_type="application/json")

    def _save(self, data: bytes, expected: str) -> Response:
        """Write the edits file."""
        try:
            version = self.store(data, expected)
        except ArgumentError as error:
            raise RefusedError(str(error)) from None
        except (SplatError, OSError) as error:
            reason = described(error) if isinstance(error, OSError) else str(error)
            raise RefusedError(reason, HTTPStatus.INTERNAL_SERVER_ERROR) from None
        if version is None:
            changed = f"{self.file.name} was changed elsewhere; download these edits, then reload the page"
            raise RefusedError(changed, HTTPStatus.PRECONDITION_FAILED)
        return PlainTextResponse("saved\n", headers={"ETag": f'"{version}"'})

    def _answer_proposals(self, request: Request) -> Response:
        """Start to judge the scene, stop that, or only tell its state."""
        if (proposing := self.proposing) is None:
            raise RefusedError("there are no proposals", HTTPStatus.NOT_FOUND)
        if request.method == "POST":
            try:
                proposing.start()
            except OSError as error:
                raise RefusedError(described(error), HTTPStatus.INTERNAL_SERVER_ERROR) from None
        elif request.method == "DELETE":
            proposing.stop()
        return Json(proposing.state())

"""Serve a page with the editor, and write the edits file that it sends.

`gsplat_edu.viewer.guard` checks every request. A write is refused unless the page has the newest version of the file,
because another tab or program may have written it.
"""

from __future__ import annotations

import http
import json
import threading
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, SplatError
from gsplat_edu.base.files import described, written_aside
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.stored import MOST_BYTES, version_of
from gsplat_edu.viewer.edit_page import read_content
from gsplat_edu.viewer.guarded import GuardedHandler, GuardedServer
from gsplat_edu.viewer.proposing import NAME, Proposing

ADDRESS = "/edits.json"
"""Where the page reads and writes its edits."""

FLOATERS = f"/{NAME}"
"""Where the page asks for splats to delete."""


class EditServer(GuardedServer):
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
        super().__init__(host, port, policy)
        self.RequestHandlerClass = _Handler
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

    def server_close(self) -> None:
        """Close the server, and end the process that judges the scene."""
        super().server_close()
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


class _Handler(GuardedHandler):
    server: EditServer

    def _answer(self) -> bytes:
        if self.path.partition("?")[0] != ADDRESS:
            return self._proposals() if self.path == FLOATERS else super()._answer()
        if (fault := self._fault()) is not None:
            self._refuse(http.HTTPStatus.FORBIDDEN, fault)
            return b""
        return self._edits()

    def _edits(self) -> bytes:
        """Send the headers of the edits file and return its content, or refuse one that the page could not apply."""
        try:
            data = self.server.content()
        except (SplatError, OSError) as error:
            reason = described(error) if isinstance(error, OSError) else str(error)
            self._refuse(http.HTTPStatus.CONFLICT, reason)
            return b""
        body = b"null\n" if data is None else data
        self.send_response(http.HTTPStatus.OK)
        self.send_header("ETag", f'"{version_of(data)}"')
        self._headers("application/json", len(body))
        return body

    def _proposals(self) -> bytes:
        """Send the headers of the state of the proposals and return it."""
        if (fault := self._fault()) is not None:
            self._refuse(http.HTTPStatus.FORBIDDEN, fault)
            return b""
        if (proposing := self.server.proposing) is None:
            self._refuse(http.HTTPStatus.NOT_FOUND, "there are no proposals")
            return b""
        if self.command == "POST":
            try:
                proposing.start()
            except OSError as error:
                self._refuse(http.HTTPStatus.INTERNAL_SERVER_ERROR, described(error))
                return b""
        elif self.command == "DELETE":
            proposing.stop()
        body = json.dumps(proposing.state()).encode() + b"\n"
        self.send_response(http.HTTPStatus.OK)
        self._headers("application/json", len(body))
        return body

    def do_POST(self) -> None:
        """Start to judge the scene."""
        if self.path != FLOATERS:
            return self._say(http.HTTPStatus.METHOD_NOT_ALLOWED)
        self.wfile.write(self._proposals())
        return None

    def do_DELETE(self) -> None:
        """Stop judging it."""
        self.do_POST()

    def do_PUT(self) -> None:
        """Write the edits file."""
        if (fault := self._fault()) is not None:
            return self._refuse(http.HTTPStatus.FORBIDDEN, fault)
        if self.path != ADDRESS:
            return self._refuse(http.HTTPStatus.NOT_FOUND, "there is nothing to write")
        expected = self.headers.get("If-Match", "").strip('"')
        if (data := self._body(MOST_BYTES)) is None:
            return None
        try:
            version = self.server.store(data, expected)
        except ArgumentError as error:
            return self._refuse(http.HTTPStatus.BAD_REQUEST, str(error))
        except OSError as error:
            return self._refuse(http.HTTPStatus.INTERNAL_SERVER_ERROR, described(error))
        except SplatError as error:
            return self._refuse(http.HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        if version is None:
            changed = (
                f"{self.server.file.name} was changed elsewhere; download these edits, then reload the page"
            )
            return self._refuse(http.HTTPStatus.PRECONDITION_FAILED, changed)
        self.send_response(http.HTTPStatus.OK)
        self.send_header("ETag", f'"{version}"')
        return self._text("saved")

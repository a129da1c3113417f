"""Serve a page with the editor, and write the edits file that it sends.

`gsplat_edu.viewer.guard` checks every request. A write is refused unless the page has the newest version of the file,
because another tab or program may have written it.
"""

from __future__ import annotations

import http
import threading
import urllib.parse
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, SplatError
from gsplat_edu.base.files import described, written_aside
from gsplat_edu.edits.document import parse_edits
from gsplat_edu.edits.identity import Identity
from gsplat_edu.edits.stored import MOST_BYTES, version_of
from gsplat_edu.viewer.edit_page import read_content
from gsplat_edu.viewer.guard import Guard
from gsplat_edu.viewer.serve import PATIENCE, PageHandler, PageServer, _Request

ADDRESS = "/edits.json"
"""Where the page reads and writes its edits."""


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
        super().__init__(b"", host, port, policy=policy)
        self.RequestHandlerClass = _Handler
        self.file = file
        self.scene: Identity | None = None
        self.guard = Guard(host, self.server_port)
        self.writing = threading.Lock()

    @property
    def url(self) -> str:
        """The page's address, with the token."""
        return f"{super().url}?token={self.guard.token}"

    def prepare(self, scene: Identity) -> None:
        """Set the scene that is edited, and check the file if it exists.

        Raises:
            ArgumentError: the file is damaged, or was made for another scene.
            OSError: it cannot be read.
        """
        self.scene = scene
        self.content()

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


class _Handler(PageHandler):
    server: EditServer
    _known = False  # whether the request brought the token

    def _answer(self) -> bytes:
        if (fault := self._fault()) is not None:
            self._refuse(http.HTTPStatus.FORBIDDEN, fault)
            return b""
        self.path = urllib.parse.urlsplit(self.path).path
        return self._edits() if self.path == ADDRESS else super()._answer()

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

    def end_headers(self) -> None:
        if self._known:
            self.send_header("Set-Cookie", self.server.guard.cookie)
        self.send_header("Referrer-Policy", "no-referrer")  # the URL is a secret
        super().end_headers()

    def do_PUT(self) -> None:
        """Write the edits file."""
        if (fault := self._fault()) is not None:
            return self._refuse(http.HTTPStatus.FORBIDDEN, fault)
        if self.path != ADDRESS:
            return self._refuse(http.HTTPStatus.NOT_FOUND, "there is nothing to write")
        length, expected = self.headers.get("Content-Length", ""), self.headers.get("If-Match", "").strip('"')
        if not length.isascii() or not length.isdigit():
            return self._refuse(http.HTTPStatus.LENGTH_REQUIRED, "the length is missing")
        if int(length) > MOST_BYTES:
            return self._refuse(http.HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {MOST_BYTES:,} bytes")
        raw = self.rfile.raw  # type: ignore[attr-defined]
        if isinstance(raw, _Request):
            raw.allow(PATIENCE, int(length) + 1)
        data = self.rfile.read(int(length))
        if len(data) != int(length):
            return self._refuse(http.HTTPStatus.BAD_REQUEST, "the request is incomplete")
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

    def _fault(self) -> str | None:
        """Return why a request is refused; None if it is not."""
        fault = self.server.guard.fault(
            self.command, self.path, lambda name: self.headers.get_all(name) or []
        )
        self._known = fault is None
        return fault

    def _refuse(self, status: http.HTTPStatus, reason: str) -> None:
        self.send_response(status)
        self._text(reason)

    def _text(self, text: str) -> None:
        body = f"{text}\n".encode("utf-8", "replace")
        self._headers("text/plain; charset=utf-8", len(body))
        if self.command != "HEAD":
            self.wfile.write(body)

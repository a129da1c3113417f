"""Serve the page of a capture, its photos on demand, and what the doctor finds about them."""

from __future__ import annotations

import functools
import http
import json
import threading
import urllib.parse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsplat_edu.base.errors import ArgumentError, DatasetError, SplatError
from gsplat_edu.base.files import described
from gsplat_edu.base.reading import parse_json
from gsplat_edu.base.text import bounded, legible
from gsplat_edu.viewer.guarded import GuardedHandler, GuardedServer

if TYPE_CHECKING:
    from gsplat_edu.viewer.capture_data import CaptureFacts

FINDINGS, LEFT_OUT, REGION, THUMBS = "/findings", "/left-out", "/region", "/thumbs/"
"""Addresses of the server, besides the page."""

SIDES = (128, 256, 512, 1024)
"""Longest sides of photos that the page may ask for, px."""

KEPT = 512
"""JPEGs in memory: about 10 MB of the smaller ones."""

DECODERS = 2
"""Photos decoded at the same time."""

MOST_JSON = 1 << 20
"""Bytes of a request that changes the list of photos to leave out, or the region."""


class CaptureServer(GuardedServer):
    """Serves the page of one capture, to browsers that have its token.

    Args:
        host: Address to listen on.
        port: Port; 0 picks a free one.
        policy: Content-Security-Policy of the page.
        capture: The capture's folder, or its transforms.json.

    Attributes:
        photos: Files of the photos by the names that the page knows; only these are served.
        marks: Names of the doctor's findings by photo; None until they are known.
        trouble: Why the doctor failed, one line; empty if it did not.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.
    """

    def __init__(self, host: str, port: int, policy: str, capture: Path) -> None:
        super().__init__(host, port, policy)
        self.RequestHandlerClass = _Handler
        self.capture = capture
        self.photos: dict[str, Path] = {}
        self.marks: Mapping[str, Sequence[str]] | None = None
        self.trouble = ""
        self._decoding = threading.Semaphore(DECODERS)
        self.photo = functools.lru_cache(KEPT)(self._photo)

    def prepare(self, title: str) -> CaptureFacts:
        """Read the capture, and put its page on the server; return what the page shows.

        Args:
            title: Heading of the page.

        Raises:
            DatasetError: the capture cannot be read.
        """
        from gsplat_edu.data.reader import CaptureReader
        from gsplat_edu.viewer import capture_page
        from gsplat_edu.viewer.capture_data import capture_facts

        found = capture_facts(CaptureReader(self.capture), title)
        cameras = zip(found.facts["cameras"], found.frames, strict=True)
        self.photos = {camera["photo"]: frame.image for camera, frame in cameras}
        self.page = capture_page.html(found, FINDINGS[1:])
        return found

    def _photo(self, name: str, side: int) -> bytes:
        """Return an upright JPEG of a photo.

        Raises:
            KeyError: the capture has no such photo.
            DatasetError: the photo cannot be decoded.
        """
        from gsplat_edu.data.thumbnails import thumbnail_jpeg

        path = self.photos[name]
        with self._decoding:
            return thumbnail_jpeg(path, side)

    def leave_out(self, photos: Sequence[str], back: bool) -> list[str]:
        """Put photos on the capture's list of those to leave out, or take them off; return all that it leaves out.

        Args:
            photos: Names that the page knows.
            back: Take them off.

        Raises:
            DatasetError: a photo is unknown, or none would be left.
            OSError: the list cannot be written.
        """
        from gsplat_edu.data.left_out import change_left_out, is_left_out, photo_path
        from gsplat_edu.data.reader import read_capture

        frames = read_capture(self.capture).frames
        known = {legible(path): path for path in (photo_path(frame, self.capture) for frame in frames)}
        listed = change_left_out(self.capture, frames, [known.get(name, name) for name in photos], back)
        return sorted(
            {
                legible(photo_path(frame, self.capture))
                for frame in frames
                if is_left_out(frame, self.capture, listed)
            }
        )

    def change_region(self, given: Any) -> None:  # noqa: ANN401
        """Write the capture's region of interest, or remove it.

        Args:
            given: A request: {"region": what region.json holds, or None}.

        Raises:
            ArgumentError: it is no such request.
            OSError: the file cannot be written.
        """
        from gsplat_edu.data.region import requested_region, write_region

        write_region(self.capture, requested_region(given))


class Examination(threading.Thread):
    """Asks the doctor about a capture and gives a server the findings by photo.

    Args:
        server: The server.
    """

    def __init__(self, server: CaptureServer) -> None:
        super().__init__(daemon=True)
        self._server = server
        self._stopping = threading.Event()

    def run(self) -> None:
        """Examine the capture; a failure becomes the server's `trouble`."""
        from gsplat_edu.data.reader import CaptureReader
        from gsplat_edu.doctor.before import examine
        from gsplat_edu.doctor.survey import prepare
        from gsplat_edu.viewer.capture_data import marks_of

        try:
            found = examine(prepare(CaptureReader(self._server.capture), self._go_on)).findings
            self._server.marks = marks_of(found)
        except InterruptedError:
            return
        except SplatError as error:
            self._server.trouble = bounded(legible(str(error)))
        except OSError as error:
            self._server.trouble = bounded(legible(described(error)))

    def _go_on(self, done: int, total: int) -> None:
        if self._stopping.is_set():
            raise InterruptedError

    def stop(self) -> None:
        """End the examination after the photos that are being measured."""
        self._stopping.set()


class _Handler(GuardedHandler):
    server: CaptureServer

    def _answer(self) -> bytes:
        address = urllib.parse.urlsplit(self.path)
        if address.path not in (FINDINGS, REGION) and not address.path.startswith(THUMBS):
            return super()._answer()
        if (fault := self._fault()) is not None:
            self._refuse(http.HTTPStatus.FORBIDDEN, fault)
            return b""
        if address.path == FINDINGS:
            marks, trouble = self.server.marks, self.server.trouble
            return self._sent(
                {"done": marks is not None or bool(trouble), "marks": marks or {}, "trouble": trouble}
            )
        return self._region() if address.path == REGION else self._thumbnail(address)

    def _region(self) -> bytes:
        """Send the headers of the region and return its JSON, or refuse it: the page may be older than the file."""
        from gsplat_edu.data.region import document_of, read_region

        try:
            region = read_region(self.server.capture)
        except DatasetError as error:
            self._refuse(http.HTTPStatus.UNPROCESSABLE_ENTITY, bounded(legible(str(error))))
            return b""
        return self._sent({"region": None if region is None else document_of(region)})

    def _thumbnail(self, address: urllib.parse.SplitResult) -> bytes:
        """Send the headers of a photo and return its bytes, or refuse it."""
        name = urllib.parse.unquote(address.path.removeprefix(THUMBS))
        side = urllib.parse.parse_qs(address.query).get("side", ["256"])[0]
        if side not in map(str, SIDES):
            self._refuse(http.HTTPStatus.BAD_REQUEST, f"side: has to be one of {', '.join(map(str, SIDES))}")
            return b""
        try:
            data = self.server.photo(name, int(side))
        except KeyError:
            self._refuse(http.HTTPStatus.NOT_FOUND, "the capture has no such photo")
            return b""
        except (SplatError, OSError) as error:
            reason = described(error) if isinstance(error, OSError) else str(error)
            self._refuse(http.HTTPStatus.UNPROCESSABLE_ENTITY, bounded(legible(reason)))
            return b""
        self.send_response(http.HTTPStatus.OK)
        self._headers("image/jpeg", len(data))
        return data

    def do_POST(self) -> None:
        """Change the list of photos to leave out, or the region."""
        if (fault := self._fault()) is not None:
            return self._refuse(http.HTTPStatus.FORBIDDEN, fault)
        if self.path not in (LEFT_OUT, REGION):
            return self._refuse(http.HTTPStatus.NOT_FOUND, "there is nothing to change")
        if (data := self._body(MOST_JSON)) is None:
            return None
        try:
            given = parse_json(data)
        except ValueError:
            given = None
        if self.path == LEFT_OUT and not _is_request(given):
            return self._refuse(
                http.HTTPStatus.BAD_REQUEST, "give photos, a list of names, and back, true or false"
            )
        try:
            if self.path == REGION:
                self.server.change_region(given)
                answer: dict[str, Any] = {}
            else:
                answer = {"left_out": self.server.leave_out(given["photos"], given["back"])}
        except (DatasetError, ArgumentError) as error:
            return self._refuse(http.HTTPStatus.BAD_REQUEST, bounded(legible(str(error))))
        except OSError as error:
            return self._refuse(http.HTTPStatus.INTERNAL_SERVER_ERROR, bounded(legible(described(error))))
        self.wfile.write(self._sent(answer))
        return None

    def _sent(self, value: Any) -> bytes:  # noqa: ANN401
        """Send the headers of a JSON answer and return its bytes."""
        data = json.dumps(value).encode("ascii")
        self.send_response(http.HTTPStatus.OK)
        self._headers("application/json", len(data))
        return data


def _is_request(given: Any) -> bool:  # noqa: ANN401
    if not isinstance(given, dict) or not isinstance(given.get("back"), bool):
        return False
    photos = given.get("photos")
    return isinstance(photos, list) and all(isinstance(photo, str) for photo in photos)

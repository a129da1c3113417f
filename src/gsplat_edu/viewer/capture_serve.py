"""Serve the page of a capture, its photos on demand, and what the doctor finds about them."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from gsplat_edu.base.errors import ArgumentError, DatasetError, SplatError
from gsplat_edu.base.files import described
from gsplat_edu.base.reading import parse_json
from gsplat_edu.base.text import bounded, legible
from gsplat_edu.server.bodies import Json, body_of
from gsplat_edu.server.page_server import PageServer
from gsplat_edu.server.refusal import RefusedError

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


class CaptureServer(PageServer):
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
        super().__init__(policy, host, port, token=True)
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
        from gsplat_edu.photos.decoding import thumbnail_jpeg

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

    def routes(self) -> list[BaseRoute]:
        """Return the addresses of the findings, the region, the photos and the list of those to leave out."""
        return [
            Route(FINDINGS, self._send_findings, methods=["GET"]),
            Route(REGION, self._answer_region, methods=["GET", "POST"]),
            Route(f"{THUMBS}{{name:path}}", self._send_photo, methods=["GET"]),
            Route(LEFT_OUT, self._change_left_out, methods=["POST"]),
        ]

    def _send_findings(self, request: Request) -> Response:
        marks, trouble = self.marks, self.trouble
        found = {"done": marks is not None or bool(trouble), "marks": marks or {}, "trouble": trouble}
        return Json(found)

    async def _answer_region(self, request: Request) -> Response:
        if request.method != "POST":
            return await run_in_threadpool(self._send_region)
        given = await _json_of(request)
        return await run_in_threadpool(_changed, functools.partial(self.change_region, given))

    def _send_region(self) -> Response:
        """Answer with the region, or refuse it: the page may be older than the file."""
        from gsplat_edu.data.region import document_of, read_region

        try:
            region = read_region(self.capture)
        except DatasetError as error:
            raise RefusedError(str(error), HTTPStatus.UNPROCESSABLE_ENTITY) from None
        return Json({"region": None if region is None else document_of(region)})

    def _send_photo(self, request: Request) -> Response:
        side = request.query_params.get("side", "256")
        if side not in map(str, SIDES):
            raise RefusedError(f"side: has to be one of {', '.join(map(str, SIDES))}")
        try:
            data = self.photo(request.path_params["name"], int(side))
        except KeyError:
            raise RefusedError("the capture has no such photo", HTTPStatus.NOT_FOUND) from None
        except (SplatError, OSError) as error:
            reason = described(error) if isinstance(error, OSError) else str(error)
            raise RefusedError(reason, HTTPStatus.UNPROCESSABLE_ENTITY) from None
        return Response(data, media_type="image/jpeg")

    async def _change_left_out(self, request: Request) -> Response:
        given = await _json_of(request)
        if not _is_request(given):
            raise RefusedError("give photos, a list of names, and back, true or false")
        change = functools.partial(self.leave_out, given["photos"], given["back"])
        return await run_in_threadpool(_changed, lambda: {"left_out": change()})


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
        from gsplat_edu.survey.capture import prepare
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


def _is_request(given: Any) -> bool:  # noqa: ANN401
    if not isinstance(given, dict) or not isinstance(given.get("back"), bool):
        return False
    photos = given.get("photos")
    return isinstance(photos, list) and all(isinstance(photo, str) for photo in photos)


async def _json_of(request: Request) -> Any:  # noqa: ANN401
    """Return the JSON of a request's body; None if it is none."""
    body = await body_of(request, MOST_JSON)
    try:
        return parse_json(body)
    except ValueError:
        return None


def _changed(change: Callable[[], Mapping[str, Any] | None]) -> Response:
    """Change the capture and answer with what the change returns, an object."""
    try:
        return Json(change() or {})
    except (DatasetError, ArgumentError) as error:
        raise RefusedError(str(error)) from None
    except OSError as error:
        raise RefusedError(described(error), HTTPStatus.INTERNAL_SERVER_ERROR) from None

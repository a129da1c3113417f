"""Watch a training in the browser while it runs: our page, from a server on this computer.

The server's threads only record requests. The training thread packs snapshots and renders pictures between two
iterations; see `gsplat_edu.viewer.snapshots`. `gsplat_edu.viewer.guard` checks every request.

    GET  /                   the page; needs the token in the URL or the cookie
    GET  /state?after=V      the state as JSON (`gsplat_edu.viewer.snapshots.state_of`, and `version`) as soon as its
                             version is not V; 204 after `WAIT` seconds without one
    GET  /scene?after=I      the Gaussians (`gsplat_edu.viewer.live_folder`: scene.bin) as soon as their iteration is
                             not I; 204 after `WAIT` seconds. The training packs Gaussians only after such a request
    POST /control            {"do": "pause" | "resume" | "step"}; 204
    POST /picture a camera as in the page's facts; a JPEG from this camera, for browsers without WebGL2
"""

from __future__ import annotations

import http
import io
import json
import math
import threading
import time
import urllib.parse
from collections.abc import Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Any

import numpy as np
import torch
from PIL import Image

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.errors import ArgumentError, SplatError
from gsplat_edu.base.reading import parse_json
from gsplat_edu.base.validation import in_range, whole_number
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.camera import Camera
from gsplat_edu.server.address import PORT, url_of
from gsplat_edu.viewer import page, page_parts
from gsplat_edu.viewer.guard import Guard
from gsplat_edu.viewer.live_folder import WAIT
from gsplat_edu.viewer.serve import CHUNK, PageHandler, PageServer
from gsplat_edu.viewer.snapshots import page_facts

NAMES = ("--view-host", "--view-port")
"""The user's names for host and port."""

GRACE = 5.0
"""Seconds after the last request during which a browser is expected to return; reloading a page takes one or two."""

PICTURE_WAIT = 20.0
"""Seconds that a request for a picture waits for the training thread."""

WIDEST = 1920
"""Longest side of a picture, px."""

LONGEST_BODY = 8 << 10
"""Bytes of a request's body; a camera takes less than one KB."""

JPEG_QUALITY = 85


class LiveView:
    """The page of a training and the server that it comes from; a `gsplat_edu.viewer.snapshots.Watcher`.

    It listens once created, and answers inside its `with` block.

    Args:
        capture: The run; its dataset is loaded.
        host: Address to listen on.
        port: Port; 0 picks a free one.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.

    Attributes:
        url: The view's address, including the token that grants access.
    """

    def __init__(self, capture: CaptureRun, host: str = LOOPBACK, port: int = PORT) -> None:
        self._trainer = capture.trainer
        html = page.live_html(page_facts(capture))
        self._server = _LiveServer(self, html, page_parts.policy(page_parts.LIVE), host, port)
        token = self._server.guard.token
        self.url = f"{url_of(host, self._server.server_port)}?token={token}"
        self._closing = ExitStack()
        self._closing.callback(self._server.server_close)
        self._news = threading.Condition()
        self._state: dict[str, Any] = {}
        self._version, self._shown, self._snapshot = 0, -1, b""
        self._asked_at = self._seen_at = -math.inf
        self._hold_from: float = math.inf  # the training waits from this iteration on
        self._wanted: Camera | None = None
        self._drawn: Camera | None = None  # the camera that the training thread draws
        self._picture: bytes | str = ""
        self._one_picture = threading.Lock()

    def __enter__(self) -> LiveView:
        """Start answering."""
        thread = threading.Thread(
            target=self._server.serve_forever, args=(0.05,), name="live view", daemon=True
        )
        thread.start()
        self._closing.callback(thread.join)
        self._closing.callback(self._server.shutdown)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the server."""
        self._closing.close()

    @property
    def watched(self) -> bool:
        """Whether a browser is connected, or was within the last `GRACE` seconds."""
        return time.perf_counter() - self._seen_at <= GRACE

    def watches(self) -> bool:
        """Return whether a browser is connected."""
        return self.watched

    def shown(self) -> int | None:
        """Return the iteration of the newest snapshot; None if no page waits for one."""
        waiting = time.perf_counter() - self._asked_at <= WAIT
        return self._shown if waiting else None

    def holds(self, iteration: int) -> bool:
        """Return whether the training has to wait; false if no browser is connected that could resume it."""
        if self._hold_from != math.inf and not self.watched:
            self._hold_from = math.inf
        return iteration >= self._hold_from

    def take_state(self, state: Mapping[str, Any]) -> None:
        """Offer a state to the pages."""
        with self._news:
            self._version += 1
            self._state = {**state, "version": self._version}
            self._news.notify_all()

    def take_scene(self, iteration: int, snapshot: bytes) -> None:
        """Offer a snapshot to the pages."""
        with self._news:
            self._shown, self._snapshot, self._asked_at = iteration, snapshot, -math.inf
            self._news.notify_all()

    def camera(self) -> Camera | None:
        """Return the camera of the picture that a page waits for."""
        self._drawn = self._wanted
        return self._drawn

    def take_picture(self, output: RenderOutput | str) -> None:
        """Give the picture to the page that waits for it."""
        picture = output if isinstance(output, str) else jpeg_of(output)
        with self._news:
            if self._wanted is self._drawn:  # else that request has given up, and another one waits
                self._wanted, self._picture = None, picture
                self._news.notify_all()

    def noticed(self) -> None:
        """Note that a browser is connected."""
        self._seen_at = time.perf_counter()

    def newer_state(self, version: int) -> dict[str, Any] | None:
        """Wait for a state of another version; None if there is none within `WAIT` seconds."""
        with self._news:
            found = self._news.wait_for(lambda: self._version not in (0, version), WAIT)
            return self._state if found else None

    def newer_scene(self, iteration: int) -> bytes | None:
        """Wait for a snapshot of another iteration; None if there is none within `WAIT` seconds.

        A page without a snapshot (-1) gets the last one at once and then asks for a newer one.
        """
        with self._news:
            is_newest = self._shown == self._trainer.iteration
            if self._shown != iteration and (is_newest or iteration < 0):
                return self._snapshot
            before = self._shown
            self._asked_at = time.perf_counter()
            found = self._news.wait_for(lambda: self._shown not in (before, iteration), WAIT)
            return self._snapshot if found else None

    def control(self, what: object) -> bool:
        """Pause, resume or take a single step; return whether the command is known."""
        if what == "pause":
            self._hold_from = -math.inf
        elif what == "resume":
            self._hold_from = math.inf
        elif what == "step":
            self._hold_from = self._trainer.iteration + 1
        else:
            return False
        return True

    def picture(self, camera: Camera) -> bytes | str:
        """Return a JPEG from a camera, or the reason why there is none. Only one request waits at a time."""
        with self._one_picture, self._news:
            self._wanted, self._picture = camera, ""
            self._news.wait_for(lambda: self._picture != "", PICTURE_WAIT)
            self._wanted = None
            return self._picture or "not drawn: the training is busy"


class _LiveHandler(PageHandler):
    server: _LiveServer

    def do_HEAD(self) -> None:
        self._refuse(http.HTTPStatus.METHOD_NOT_ALLOWED)

    def do_GET(self) -> None:
        if not self._let_in():
            return
        view, target = self.server.view, urllib.parse.urlsplit(self.path)
        view.noticed()
        after = _number(urllib.parse.parse_qs(target.query).get("after", [""])[0])
        if target.path == "/":
            policy = f"{self.server.policy}; frame-ancestors 'none'"
            more = {"Set-Cookie": self.server.guard.cookie, "Content-Security-Policy": policy}
            self._reply(http.HTTPStatus.OK, self.server.page, "text/html; charset=utf-8", more)
        elif target.path == "/state":
            state = view.newer_state(after)
            self._offer(None if state is None else json.dumps(state).encode("ascii"), "application/json")
        elif target.path == "/scene":
            self._offer(view.newer_scene(after), "application/octet-stream")
        else:
            self._refuse(http.HTTPStatus.NOT_FOUND)
        view.noticed()

    def do_POST(self) -> None:
        if not self._let_in():
            return
        self.server.view.noticed()
        length = _number(self.headers.get("Content-Length", ""))
        if not 0 <= length <= LONGEST_BODY:
            self.rfile.read(min(max(length, 0), 8 * LONGEST_BODY))  # an answer before it would be lost
            self._refuse(http.HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            return
        try:
            body = parse_json(self.rfile.read(length))
        except ValueError:
            body = None
        if self.path == "/control" and isinstance(body, dict) and self.server.view.control(body.get("do")):
            self._offer(None, "")
        elif self.path == "/picture":
            self._draw(body)
        else:
            self._refuse(http.HTTPStatus.BAD_REQUEST)

    def _draw(self, body: object) -> None:
        try:
            camera = picture_camera(body)
        except ArgumentError as error:
            self._refuse(http.HTTPStatus.BAD_REQUEST, str(error))
            return
        picture = self.server.view.picture(camera)
        if isinstance(picture, str):
            self._refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, picture)
        else:
            self._offer(picture, "image/jpeg")

    def _let_in(self) -> bool:
        fault = self.server.guard.fault(
            self.command, self.path, lambda name: self.headers.get_all(name) or []
        )
        if fault is not None:
            self._refuse(http.HTTPStatus.FORBIDDEN, fault)
        return fault is None

    def _offer(self, body: bytes | None, kind: str) -> None:
        """Send the body with status 200, or status 204 without one."""
        if body is None:
            self._reply(http.HTTPStatus.NO_CONTENT, b"", "text/plain")
        else:
            self._reply(http.HTTPStatus.OK, body, kind)

    def _refuse(self, status: http.HTTPStatus, reason: str = "") -> None:
        """Send an error, with one line for the user."""
        text = f"{status.value} {status.phrase}{reason and ': '}{reason}\n".encode()
        more = {"Allow": "GET, POST"} if status is http.HTTPStatus.METHOD_NOT_ALLOWED else None
        self._reply(status, text, "text/plain; charset=utf-8", more)

    def _reply(
        self, status: http.HTTPStatus, body: bytes, kind: str, more: Mapping[str, str] | None = None
    ) -> None:
        self.send_response(status)
        self.send_header("Referrer-Policy", "no-referrer")  # the URL is a secret
        for name, value in (more or {}).items():
            self.send_header(name, value)
        self._headers(kind, len(body))
        whole = memoryview(body if self.command != "HEAD" else b"")
        for begin in range(0, len(whole), CHUNK):
            self.wfile.write(whole[begin : begin + CHUNK])


class _LiveServer(PageServer):
    """Serves the page of a training and answers its requests."""

    def __init__(self, view: LiveView, html: bytes, policy: str, host: str, port: int) -> None:
        super().__init__(html, host, port, NAMES, policy)
        self.RequestHandlerClass = _LiveHandler
        self.view = view
        self.guard = Guard(host, self.server_port)


def picture_camera(value: object) -> Camera:
    """Make a camera from a browser's JSON.

    Args:
        value: An object with R, eye, fx, fy, cx, cy, W and H, as in the page's facts.

    Raises:
        ArgumentError: it does not describe a camera, or one whose image is too large.
    """
    if not isinstance(value, dict):
        raise ArgumentError("camera: is not an object")
    try:
        given = {name: value[name] for name in ("R", "eye", "fx", "fy", "cx", "cy", "W", "H")}
        W, H = (whole_number(name, given.pop(name), 1, WIDEST) for name in ("W", "H"))
        focal = {name: in_range(name, given.pop(name), 0.0, 1e9, open_low=True) for name in ("fx", "fy")}
        return Camera(**given, **focal, H=H, W=W)
    except KeyError as error:
        raise ArgumentError(f"camera: lacks {error}") from None
    except (SplatError, ValueError, TypeError, OverflowError) as error:
        raise ArgumentError(f"camera: {str(error)[:200]}") from None


def jpeg_of(output: RenderOutput) -> bytes:
    """Return a render as a JPEG; NaN is black."""
    levels = torch.nan_to_num(output.image).clamp(0.0, 1.0) * 255.0 + 0.5
    made = io.BytesIO()
    Image.fromarray(np.asarray(levels.to(torch.uint8).numpy(force=True))).save(
        made, "JPEG", quality=JPEG_QUALITY
    )
    return made.getvalue()


def _number(text: str) -> int:
    """Return a whole number in ASCII digits; -1 for anything else."""
    return int(text) if text.isascii() and text.isdigit() and len(text) < 16 else -1

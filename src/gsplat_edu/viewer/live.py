"""Watch a training in the browser while it runs: our page, from a server on this computer.

The server's threads only record requests. The training thread packs snapshots and renders pictures between two
iterations; see `gsplat_edu.viewer.snapshots`. `gsplat_edu.server.guard` checks every request.

    GET  /                   the page; needs the token in the URL or the cookie
    GET  /state?after=V      the state as JSON (`gsplat_edu.viewer.snapshots.state_of`, and `version`) as soon as its
                             version is not V; 204 after `WAIT` seconds without one
    GET  /scene?after=I      the Gaussians (`gsplat_edu.viewer.live_folder`: scene.bin) as soon as their iteration is
                             not I; 204 after `WAIT` seconds. The training packs Gaussians only after such a request
    POST /control            {"do": "pause" | "resume" | "step"}; 204
    POST /picture a camera as in the page's facts; a JPEG from this camera, for browsers without WebGL2
"""

from __future__ import annotations

import asyncio
import functools
import io
import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
import torch
from PIL import Image
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from gsplat_edu.base.constants import LOOPBACK
from gsplat_edu.base.errors import ArgumentError, SplatError
from gsplat_edu.base.reading import parse_json
from gsplat_edu.base.text import whole_of
from gsplat_edu.base.validation import in_range, whole_number
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.camera import Camera
from gsplat_edu.server.address import PORT
from gsplat_edu.server.bodies import Json, body_of
from gsplat_edu.server.page_server import PageServer
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.server.serving import MOST_CONNECTIONS
from gsplat_edu.viewer import page, page_parts
from gsplat_edu.viewer.live_folder import WAIT
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

Found = TypeVar("Found")
"""What a request waits for."""


class LiveView:
    """The page of a training and the server that it comes from; a `gsplat_edu.viewer.snapshots.Watcher`.

    It listens once created, and answers inside its `with` block.

    Args:
        capture: The run; its dataset is loaded.
        host: Address to listen on.
        port: Port; 0 picks a free one.
        grace: Seconds without a request after which no browser counts as connected.
        wait: Seconds after which a request for something new is answered without it.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.

    Attributes:
        url: The view's address, including the token that grants access.
    """

    def __init__(
        self,
        capture: CaptureRun,
        host: str = LOOPBACK,
        port: int = PORT,
        *,
        grace: float = GRACE,
        wait: float = WAIT,
    ) -> None:
        self.grace, self.wait = grace, wait
        self._trainer = capture.trainer
        html = page.live_html(page_facts(capture))
        self._server = _LiveServer(self, page_parts.policy(page_parts.LIVE), host, port)
        self._server.page = html
        self.url = self._server.url
        self._is_over = False
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
        self._server.start(self._server.application())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the requests that wait, and stop the server."""
        with self._news:
            self._is_over = True
            self._news.notify_all()
        self._server.stop()

    @property
    def watched(self) -> bool:
        """Whether a browser is connected, or was within the last `grace` seconds."""
        return time.perf_counter() - self._seen_at <= self.grace

    def watches(self) -> bool:
        """Return whether a browser is connected."""
        return self.watched

    def shown(self) -> int | None:
        """Return the iteration of the newest snapshot; None if no page waits for one."""
        waiting = time.perf_counter() - self._asked_at <= self.wait
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
        """Wait for a state of another version; None if there is none within `wait` seconds."""
        with self._news:
            is_newer = self._wait(lambda: self._version not in (0, version), self.wait)
            return self._state if is_newer else None

    def newer_scene(self, iteration: int) -> bytes | None:
        """Wait for a snapshot of another iteration; None if there is none within `wait` seconds.

        A page without a snapshot (-1) gets the last one at once and then asks for a newer one.
        """
        with self._news:
            is_newest = self._shown == self._trainer.iteration
            if self._shown != iteration and (is_newest or iteration < 0):
                return self._snapshot
            before = self._shown
            self._asked_at = time.perf_counter()
            is_newer = self._wait(lambda: self._shown not in (before, iteration), self.wait)
            return self._snapshot if is_newer else None

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
            self._wait(lambda: self._picture != "", PICTURE_WAIT)
            self._wanted = None
            return self._picture or "not drawn: the training is busy"

    def _wait(self, is_there: Callable[[], bool], seconds: float) -> bool:
        """Wait for something to be there, with the lock held; return whether it is. The view's end ends all waiting."""
        return self._news.wait_for(lambda: self._is_over or is_there(), seconds) and is_there()


class _LiveServer(PageServer):
    """Serves the page of a training and answers its requests.

    Requests that wait for the training do so in threads of their own, so that they keep no other request waiting.
    """

    def __init__(self, view: LiveView, policy: str, host: str, port: int) -> None:
        super().__init__(policy, host, port, NAMES, token=True)
        self._view = view
        self._threads = ThreadPoolExecutor(MOST_CONNECTIONS, "live view")

    def stop(self) -> None:
        """Stop the server and its threads."""
        super().stop()
        self._threads.shutdown()

    def routes(self) -> list[BaseRoute]:
        """Return the addresses that the module's description lists."""
        return [
            Route("/state", self._send_state, methods=["GET"]),
            Route("/scene", self._send_scene, methods=["GET"]),
            Route("/control", self._control, methods=["POST"]),
            Route("/picture", self._draw, methods=["POST"]),
        ]

    def _page(self, request: Request) -> Response:
        self._view.noticed()
        return super()._page(request)

    async def _send_state(self, request: Request) -> Response:
        state = await self._waited(functools.partial(self._view.newer_state, _after(request)))
        return _nothing() if state is None else Json(state)

    async def _send_scene(self, request: Request) -> Response:
        scene = await self._waited(functools.partial(self._view.newer_scene, _after(request)))
        return _nothing() if scene is None else Response(scene, media_type="application/octet-stream")

    async def _control(self, request: Request) -> Response:
        body = await self._json_of(request)
        if not isinstance(body, dict) or not self._view.control(body.get("do")):
            raise RefusedError("do: has to be pause, resume or step")
        return _nothing()

    async def _draw(self, request: Request) -> Response:
        given = await self._json_of(request)
        try:
            camera = picture_camera(given)
        except ArgumentError as error:
            raise RefusedError(str(error)) from None
        picture = await self._waited(functools.partial(self._view.picture, camera))
        if isinstance(picture, str):
            raise RefusedError(picture, HTTPStatus.SERVICE_UNAVAILABLE)
        return Response(picture, media_type="image/jpeg")

    async def _json_of(self, request: Request) -> Any:  # noqa: ANN401
        """Return the JSON of a request's body; None if it is none."""
        self._view.noticed()
        body = await body_of(request, LONGEST_BODY)
        try:
            return parse_json(body)
        except ValueError:
            return None

    async def _waited(self, ask: Callable[[], Found]) -> Found:
        """Wait for an answer of the view in a thread, while a browser counts as connected."""
        self._view.noticed()
        found = await asyncio.get_running_loop().run_in_executor(self._threads, ask)
        self._view.noticed()
        return found


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


def _nothing() -> Response:
    return Response(status_code=HTTPStatus.NO_CONTENT)


def _after(request: Request) -> int:
    """Return the number of what the page has already; -1 for anything that is no number."""
    number = whole_of(request.query_params.get("after", ""))
    return -1 if number is None else number

"""Watch a training in the browser while it runs, rendered from the browser's camera.

viser serves its client and a WebSocket from its own threads, which only record the browsers' input. The training thread
reads this input between two steps, while nothing else touches the Gaussians, and renders there. Rendering changes
nothing, so a watched training gives the same bits as an unwatched one.

viser opens one TCP port for its client's files and the WebSocket. Its tunnel to a public server is disabled here, and
`gsplat_edu.viewer.live_guard` checks every request.
"""

from __future__ import annotations

import functools
import logging
import math
import queue
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import TracebackType

import numpy as np
import rich
import torch
import viser
import viser.transforms
from jaxtyping import Float64

from gsplat_edu.camera import Camera
from gsplat_edu.errors import ArgumentError, SplatError
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.evaluate.paths import common_up
from gsplat_edu.gaussian_math import quat_to_R
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Trainer
from gsplat_edu.validation import ArrayLike, in_range, whole_number
from gsplat_edu.viewer.live_guard import Guard
from gsplat_edu.viewer.page_start import pivot_of
from gsplat_edu.viewer.serve import LOOPBACK, free_port, url_of
from gsplat_edu.views import View

PORT = 8080

NAMES = ("--view-host", "--view-port")
"""The user's names for host and port."""

SHARE = 0.2
"""Largest fraction of the time spent on browsers during training."""

WIDTHS = (160, 1920)
"""Smallest and largest width that the browser can choose, px; the image is never wider than the browser's own."""

START_WIDTH = 800
"""Initial width of the image, px."""

MOVING = 0.4
"""Fraction of the width that is rendered while the camera moves."""

SETTLED = 0.3
"""Seconds without a move after which the camera counts as still."""

STILL_EVERY = 0.2
"""Seconds between two images for a still camera while the training changes the scene."""

FIGURES_EVERY = 0.5
"""Seconds between two updates of loss and PSNR."""

POLL = 0.03
"""Seconds between two polls of the browsers while the training is paused."""

GRACE = 5.0
"""Seconds after which a disconnected browser is not expected to return; reloading a page takes one or two."""

JPEG_QUALITY = 85

MOST_ASPECT = 4.0
"""Largest aspect ratio of a browser's image, in either direction."""

WIDEST_FOV = math.radians(170.0)


def browser_camera(
    wxyz: ArrayLike, position: ArrayLike, fov: float, canvas: tuple[int, int], width: int
) -> Camera:
    """Convert viser's camera. Its axes agree with ours (+z forward, y down); only the rotation is inverted.

    Args:
        wxyz: (4,) quaternion of the camera-to-world rotation.
        position: (3,) camera centre, world units.
        fov: Vertical field of view, radians.
        canvas: Width and height of the browser's image, px.
        width: Width of the image to render, px; at most the browser's.

    Returns:
        A camera whose image, stretched over the browser's, shows the same view to the pixel.

    Raises:
        ArgumentError: the browser sent values that do not form a camera.
    """
    columns, rows = whole_number("width", canvas[0], 1), whole_number("height", canvas[1], 1)
    aspect = in_range("aspect", columns / rows, 1 / MOST_ASPECT, MOST_ASPECT)
    tangent = math.tan(in_range("fov", fov, 0.0, WIDEST_FOV, open_low=True) / 2)
    W = min(whole_number("width", width, 1), columns)
    H = max(1, round(W / aspect))
    fx, fy = W / 2 / (tangent * aspect), H / 2 / tangent  # pixels are not quite square where H was rounded
    return Camera(quat_to_R(wxyz).T, position, fx, fy, (W - 1) / 2, (H - 1) / 2, H, W)


@dataclass
class _Browser:
    """A connected browser and its last image: time stamp of the camera, width, iteration, and time of sending."""

    handle: viser.ClientHandle
    stamp: float
    moved_at: float = -math.inf
    drawn: tuple[float, int, int] | None = None
    drawn_at: float = -math.inf


class LiveView:
    """Shows a training to browsers and lets them pause it.

    Args:
        capture: The run; its dataset is loaded, its trainer may come later.
        stop: Returns whether the program should end.
        host: Address to listen on.
        port: Port; 0 picks a free one.

    Raises:
        ArgumentError: the address does not belong to this computer, or the port is in use or out of range.

    Attributes:
        url: The view's address, including the token that grants access.
    """

    def __init__(
        self, capture: CaptureRun, stop: Callable[[], bool], host: str = LOOPBACK, port: int = PORT
    ) -> None:
        self._capture, self._stop = capture, stop
        self._render = capture.options.renderer
        self._trainer: Trainer | None = None
        self._event: StepEvent | None = None
        self._browsers: dict[int, _Browser] = {}
        self._commands: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._left = math.inf  # iterations until the training pauses
        self._free_at = self._figures_at = -math.inf
        self._seen_at = -math.inf
        self._state = self._said = self._failure = ""
        with ExitStack() as closing:
            self._server, token = _server(host, port, closing)
            self.url = f"{url_of(host, self._server.get_port())}?token={token}"
            self._set_scene()
            self._add_panel()
            self._closing = closing.pop_all()

    def __enter__(self) -> LiveView:
        """Return the view itself; it has been listening since its creation."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the server and every connection."""
        self._closing.close()

    @property
    def watched(self) -> bool:
        """Whether a browser is connected, or disconnected so recently that it may return."""
        now = time.perf_counter()
        self._poll_browsers(now)
        return now - self._seen_at <= GRACE

    def show(self, trainer: Trainer, event: Event) -> None:
        """Serve the browsers after a training step, in the trainer's thread; block while the training is paused.

        A callback of the trainer. It takes at most `SHARE` of the time, and microseconds if no browser is connected.
        """
        if not isinstance(event, StepEvent):
            return
        self._trainer, self._event = trainer, event
        self._left = max(self._left - 1, 0)
        with self._capture.clock_stopped():
            self.update()
            if self._left == 0:
                self._hold()

    def update(self, state: str = "training") -> None:
        """Serve the browsers once if an image is due.

        Args:
            state: The program's current activity, shown in the panel.
        """
        while not self._commands.empty():
            self._commands.get()()
        now = time.perf_counter()
        self._poll_browsers(now)
        if not self._browsers or now < self._free_at:
            return
        if now - self._figures_at >= FIGURES_EVERY:
            self._figures_at = now
            self._say(state)
        self._draw(now)
        self._free_at = now + (time.perf_counter() - now) / SHARE

    def stay(self) -> None:
        """Show the finished scene until no browser is connected or the program should end."""
        self._left = math.inf
        self._pause.disabled = self._step.disabled = True
        self._wait("finished", lambda: False)

    def _hold(self) -> None:
        """Wait for a single step, a resume, the last browser to leave, or the end of the program."""
        self._pause.label = "Resume"
        self._wait("paused", lambda: self._left > 0)
        if self._left == 0:  # no browser is left to resume it
            self._left = math.inf
        if self._left == math.inf:
            self._pause.label = "Pause"

    def _wait(self, state: str, over: Callable[[], bool]) -> None:
        """Serve the browsers until `over` returns true, the program should end, or no browser is left."""
        self._say(state)
        while not (over() or self._stop()):
            if not self.watched:
                return
            self._draw(time.perf_counter())
            try:
                self._commands.get(timeout=POLL)()
            except queue.Empty:
                continue

    def _poll_browsers(self, now: float) -> None:
        """Update the list of browsers and detect moved cameras."""
        handles = self._server.get_clients()
        for gone in self._browsers.keys() - handles.keys():
            del self._browsers[gone]
        for number, handle in handles.items():
            stamp = handle.camera.update_timestamp
            if number not in self._browsers:
                self._browsers[number] = _Browser(handle, stamp)
            elif stamp != self._browsers[number].stamp:
                self._browsers[number].stamp, self._browsers[number].moved_at = stamp, now
        if handles:
            self._seen_at = now

    def _draw(self, now: float) -> None:
        """Send one image, to the browser that has waited longest for one."""
        if self._trainer is None:
            return
        due = [browser for browser in self._browsers.values() if self._is_due(browser, now)]
        if not due:
            return
        browser = min(due, key=lambda candidate: candidate.drawn_at)
        browser.drawn, browser.drawn_at = self._wanted(browser, now), now
        seen, width = browser.handle.camera, browser.drawn[1]
        canvas = (seen.image_width, seen.image_height)
        try:
            camera = browser_camera(seen.wxyz, seen.position, seen.fov, canvas, width)
        except ArgumentError:
            return  # the browser has sent no camera yet, or an invalid one: the next may be valid
        try:
            with torch.no_grad():
                image = self._render(self._trainer.gaussians, camera).image
        except (SplatError, MemoryError, torch.cuda.OutOfMemoryError) as error:
            self._note_failure(f"not drawn: {str(error) or 'out of memory'}")
            return
        self._note_failure("")
        levels = torch.nan_to_num(image).clamp(0.0, 1.0) * 255.0 + 0.5
        with warnings.catch_warnings():  # viser warns if the browser has just disconnected
            warnings.simplefilter("ignore")
            browser.handle.scene.set_background_image(
                levels.to(torch.uint8).numpy(force=True), format="jpeg", jpeg_quality=JPEG_QUALITY
            )
        browser.handle.flush()

    def _wanted(self, browser: _Browser, now: float) -> tuple[float, int, int]:
        """Return the image that a browser should have: time stamp of its camera, width, iteration."""
        asked = int(
            min(WIDTHS[1], max(WIDTHS[0], self._width.value))
        )  # in this order, NaN becomes the smallest width
        width = min(asked, browser.handle.camera.image_width)
        if now - browser.moved_at < SETTLED:
            width = round(MOVING * width)
        return browser.stamp, width, 0 if self._trainer is None else self._trainer.iteration

    def _is_due(self, browser: _Browser, now: float) -> bool:
        wanted = self._wanted(browser, now)
        if browser.drawn is None or wanted[:2] != browser.drawn[:2]:
            return True
        return wanted != browser.drawn and now - browser.drawn_at >= STILL_EVERY

    def _note_failure(self, failure: str) -> None:
        """Show in the panel why the last image was not drawn, or that it was: training continues either way."""
        if failure != self._failure:
            self._failure = failure
            self._say(self._state)

    def _say(self, state: str) -> None:
        """Show the metrics of the last step."""
        self._state = state
        lines = [f"**{state}**"]
        if self._event is not None and self._trainer is not None:
            total = self._trainer.config.iterations
            lines += [
                f"iteration {self._trainer.iteration:,} of {total:,}",
                _gaussians(self._trainer),
                f"loss {self._event.loss:.4f}",
            ]
            if self._trainer.last is not None:
                lines.append(f"PSNR {_psnr(self._trainer):.2f} dB (last photo)")
                height, width, _ = self._trainer.last[0].shape
                lines.append(f"photos at {width} x {height} px" + _share(self._event.photo_factor))
        if self._failure:
            lines.append(f"`{self._failure.replace('`', '')}`")
        said = "  \n".join(lines)  # two spaces force a line break in Markdown
        if said != self._said:
            self._said = self._figures.content = said

    def _set_scene(self) -> None:
        cameras = [view.camera for view in self._capture.dataset.train]
        self._up = common_up(cameras)
        first, start = cameras[0], self._server.initial_camera
        pivot = pivot_of(cameras, 0, self._capture.dataset.points)
        self._distance = float((pivot - first.eye) @ first.R[2])
        self._server.scene.set_up_direction(self._up)
        start.position = first.eye
        start.look_at = first.eye + self._distance * first.R[2]
        start.fov = _vertical_fov(first)

    def _add_panel(self) -> None:
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        gui.set_panel_label("gsplat-edu train")
        self._figures = gui.add_markdown("loading photos")
        self._pause, self._step = gui.add_button("Pause"), gui.add_button("Step")
        low, high = WIDTHS
        self._width = gui.add_slider("Width (px)", low, high, step=20, initial_value=START_WIDTH)
        self._pause.on_click(lambda event: self._commands.put(self._toggle))
        self._step.on_click(lambda event: self._commands.put(self._step_once))
        dataset = self._capture.dataset
        start = dataset.train[0].camera
        reset = gui.add_button("Reset view")
        reset.on_click(lambda event: self._send(event.client, start, self._up))
        views = _cameras(dataset.train, dataset.test)
        cameras = gui.add_dropdown("Camera", list(views), initial_value=dataset.train[0].name)
        cameras.on_update(lambda event: self._send(event.client, views.get(event.target.value)))

    def _send(
        self,
        browser: viser.ClientHandle | None,
        camera: Camera | None,
        up: Float64[np.ndarray, "3"] | None = None,
    ) -> None:
        """Ask the training thread to move a browser to a camera; see `_move`."""
        if browser is not None and camera is not None:  # a browser may send a name that is not in the list
            self._commands.put(functools.partial(self._move, browser, camera, up))

    def _move(self, browser: viser.ClientHandle, camera: Camera, up: Float64[np.ndarray, "3"] | None) -> None:
        """Move a browser to a camera, with `up` upwards; None takes the camera's own up."""
        seen = browser.camera
        if not seen.update_timestamp:  # it has not sent its camera yet
            return
        with warnings.catch_warnings(), browser.atomic():  # viser warns if the browser has just disconnected
            warnings.simplefilter("ignore")
            seen.fov = _vertical_fov(camera)
            seen.position = camera.eye
            seen.look_at = camera.eye + self._distance * camera.R[2]
            if up is None:
                seen.wxyz = viser.transforms.SO3.from_matrix(camera.R.T).wxyz
            else:
                seen.up_direction = up
        browser.flush()

    def _toggle(self) -> None:
        self._left = 0 if self._left == math.inf else math.inf

    def _step_once(self) -> None:
        self._left = 1


class _Server(viser.ViserServer):
    """viser without its tunnel. Any browser could request the tunnel, which exposes the view to the internet."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse."""
        return None


def _server(host: str, port: int, closing: ExitStack) -> tuple[viser.ViserServer, str]:
    """Start viser's server and return it with its token; `closing` receives the clean-up.

    If the port is in use, viser would take the next free one; if the address cannot be bound, it would wait forever.
    """
    wanted = free_port(host, port, NAMES)
    closing.enter_context(_silence())
    guard = Guard(host, wanted)
    with guard.installed():
        server = _Server(host=host, port=wanted, label="gsplat-edu", verbose=False)
        closing.callback(server.stop)
    if server.get_port() != wanted:
        raise ArgumentError(
            f"{NAMES[1]}: {wanted} has just been taken; choose another port, or 0 for any free one"
        )
    return server, guard.token


@contextmanager
def _silence() -> Iterator[None]:
    """Keep viser's console output and its WebSocket log off the terminal."""
    console, logger = rich.get_console(), logging.getLogger("websockets")
    before = console.quiet, logger.level
    console.quiet = True
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        console.quiet = before[0]
        logger.setLevel(before[1])


def _cameras(train: Sequence[View], test: Sequence[View]) -> dict[str, Camera]:
    """Return the cameras by their names in the list, in the capture's order."""
    names = {view.name: view.name for view in train} | {view.name: f"{view.name} (held out)" for view in test}
    return {names[view.name]: view.camera for view in sorted([*train, *test], key=lambda view: view.name)}


def _vertical_fov(camera: Camera) -> float:
    return 2.0 * math.atan(camera.H / 2 / camera.fy)


def _psnr(trainer: Trainer) -> float:
    try:
        return math.nan if trainer.last is None else psnr(*trainer.last)
    except SplatError:  # an image with NaN or infinity has no PSNR
        return math.nan


def _gaussians(trainer: Trainer) -> str:
    cap = trainer.config.max_gaussians
    return f"{len(trainer.gaussians):,}" + (f" of at most {cap:,}" if cap is not None else "") + " Gaussians"


def _share(factor: float) -> str:
    return "" if factor == 1.0 else f", 1/{factor:.3g} of their width"

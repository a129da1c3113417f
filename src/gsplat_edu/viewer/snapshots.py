"""Shows a training to its watchers between two iterations, within a small fraction of the time.

A `Watcher` is a page on this program's own server (`gsplat_edu.viewer.live`), or another process that reads files
(`FolderWatcher`, see `gsplat_edu.viewer.live_folder`). The training thread asks it after every iteration what it needs.
Packing the Gaussians and measuring changes nothing, so a watched training gives the same bits as an unwatched one.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import torch

from gsplat_edu.base.errors import SplatError
from gsplat_edu.base.files import described
from gsplat_edu.base.locks import POLL
from gsplat_edu.base.records import without_nan
from gsplat_edu.base.text import Told
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.schedule import sh_degree
from gsplat_edu.train.trainer import Trainer
from gsplat_edu.viewer import page_data
from gsplat_edu.viewer.live_folder import LiveFolder, framed
from gsplat_edu.viewer.page import live_facts, live_html

SHARE = 0.02
"""Largest fraction of the training's time spent on snapshots and figures. The page draws them on the same processor and
adapts the rate of its requests."""

PICTURE_SHARE = 0.2
"""Largest fraction of the training's time spent on pictures for browsers without WebGL2."""

STATE_EVERY = 0.5
"""Seconds between two states."""

BEAT = 2.0
"""Seconds after which a state is repeated although nothing changed."""

MOST_POINTS = 240
"""Points of the curves; when there are more, every second one is dropped."""


@runtime_checkable
class Watcher(Protocol):
    """A watcher of a training. Its methods are called in the training thread, after every iteration."""

    def watches(self) -> bool:
        """Return whether it wants to know the state now."""
        ...

    def shown(self) -> int | None:
        """Return the iteration of the scene that it has, -1 for none; None if it needs no newer scene now."""
        ...

    def holds(self, iteration: int) -> bool:
        """Return whether the training has to wait after this number of iterations."""
        ...

    def take_state(self, state: Mapping[str, Any]) -> None:
        """Receive the state; see `state_of`."""
        ...

    def take_scene(self, iteration: int, snapshot: bytes) -> None:
        """Receive Gaussians as the bytes of `scene.bin`; see `gsplat_edu.viewer.live_folder`."""
        ...

    def camera(self) -> Camera | None:
        """Return the camera of the picture that it waits for, or None."""
        ...

    def take_picture(self, output: RenderOutput | str) -> None:
        """Receive the render from its camera, or the reason why there is none."""
        ...


class FolderWatcher:
    """Another process that watches by the files of `gsplat_edu.viewer.live_folder`.

    If a file cannot be written, it reports this once and stops writing; the training continues.

    Args:
        run: The run's folder.
        facts: Returns the facts of the page; called once it is asked for.
        say: Receives sentences for the user.
    """

    def __init__(
        self, run: LiveFolder, facts: Callable[[], Mapping[str, Any]], say: Callable[[str], None]
    ) -> None:
        self._folder, self._facts, self._say = run, facts, say
        self._looked_at, self._wanted, self._paused = -math.inf, False, False
        self._has_page = self._failed = False
        self._shown, self._version = -1, 0
        self._try(self._folder.clear)  # files of a killed training

    def watches(self) -> bool:
        """Return whether the files were asked for a short time ago."""
        self._look()
        return self._wanted

    def shown(self) -> int | None:
        """Return the iteration of scene.bin; None if nobody asks for it."""
        return self._shown if self.watches() else None

    def holds(self, iteration: int) -> bool:
        """Return whether the file `pause` is present."""
        self._look()
        return self._paused

    def take_state(self, state: Mapping[str, Any]) -> None:
        """Write state.json, and the page before the first one."""

        def write() -> None:
            if not self._has_page:
                facts = dict(self._facts())
                self._folder.write(self._folder.page, facts)
                self._folder.write_bytes(self._folder.html, live_html(facts, step=False))
                self._has_page = True
            self._version += 1
            more = {"version": self._version, "scene": self._shown, "pid": os.getpid()}
            self._folder.write(self._folder.state, {**state, **more})

        self._try(write)

    def take_scene(self, iteration: int, snapshot: bytes) -> None:
        """Write scene.bin."""
        self._try(lambda: self._folder.write_bytes(self._folder.scene, snapshot))
        self._shown = iteration

    def camera(self) -> Camera | None:
        """Return None, because readers of the files draw by themselves."""
        return None

    def take_picture(self, output: RenderOutput | str) -> None:
        """Do nothing; see `camera`."""

    def close(self) -> None:
        """Remove the files."""
        self._try(self._folder.clear)

    def _look(self) -> None:
        now = time.perf_counter()
        if now - self._looked_at < POLL:
            return
        self._looked_at = now
        self._wanted = not self._failed and self._folder.is_wanted()
        before, self._paused = self._paused, self._folder.is_paused()
        if self._paused and not before:
            self._say(Told(f"paused; remove {self._folder.pause} to continue", ""))

    def _try(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            if not self._failed:
                self._say(f"the live view of the run's folder ends: {described(error)}")
            self._failed, self._wanted = True, False


class Broadcast:
    """Serves the watchers of a training, and lets them pause it.

    Args:
        capture: The run.
        stop: Returns whether the program should end; ends a pause.
        watchers: The watchers.
    """

    def __init__(self, capture: CaptureRun, stop: Callable[[], bool], watchers: Sequence[Watcher]) -> None:
        self._capture, self._stop, self._watchers = capture, stop, watchers
        self._trainer = capture.trainer
        self._figures = Figures(capture.trainer)
        self._free_at = self._picture_at = self._stated_at = -math.inf
        self._stated: tuple[str, int] | None = None
        self._failure, self._seconds = "", 0.0

    def show(self, trainer: Trainer, event: Event) -> None:
        """Serve the watchers after a training step; block while one of them holds the training.

        A callback of the trainer. It takes at most `SHARE` of the time, and microseconds if nobody watches.
        """
        if not isinstance(event, StepEvent):
            return
        self._figures.note(event)
        self._seconds = self._capture.elapsed
        with self._capture.clock_stopped():
            self.update()
            if self._is_held():
                self._figures.interrupted()
                while self._is_held() and not self._stop():
                    self._serve("paused", waiting=True)
                    time.sleep(POLL)
                self._figures.interrupted()

    def update(self, state: str = "training") -> None:
        """Serve the watchers if their next turn has come.

        Args:
            state: What the program is doing, as for `state_of`.
        """
        self._serve(state, waiting=False)

    def stay(self, watched: Callable[[], bool]) -> None:
        """Show the finished scene until `watched` is false or the program should end.

        Args:
            watched: Returns whether a watcher is connected.
        """
        while watched() and not self._stop():
            self._serve("finished", waiting=True)
            time.sleep(POLL)

    def _is_held(self) -> bool:
        return any(watcher.holds(self._trainer.iteration) for watcher in self._watchers)

    def _serve(self, state: str, waiting: bool) -> None:
        """Serve the watchers; the limits on time hold unless the training waits."""
        now = time.perf_counter()
        if waiting or now >= self._picture_at:
            self._draw()
            self._picture_at = now + (time.perf_counter() - now) / PICTURE_SHARE
        now = time.perf_counter()
        if now < self._free_at and not waiting:
            return
        watching = [watcher for watcher in self._watchers if watcher.watches()]
        if watching:
            self._tell(watching, state, now)
        taken = time.perf_counter() - now
        self._free_at = now + max(taken / SHARE, POLL)

    def _tell(self, watching: Sequence[Watcher], state: str, now: float) -> None:
        iteration = self._trainer.iteration
        behind = [watcher for watcher in watching if watcher.shown() not in (None, iteration)]
        if behind:
            self._send_scene(behind, iteration)
        since = now - self._stated_at
        news = self._stated != (state, iteration)
        if (news and (since >= STATE_EVERY or behind)) or since >= BEAT:
            self._stated, self._stated_at = (state, iteration), now
            self._figures.measure(self._trainer)
            said = state_of(self._trainer, self._figures, state, self._seconds, self._failure)
            for watcher in watching:
                watcher.take_state(said)

    def _send_scene(self, watchers: Sequence[Watcher], iteration: int) -> None:
        try:
            snapshot = snapshot_of(self._trainer)
        except MemoryError:
            self._failure = "the scene is not shown: out of memory"
            return
        self._failure = ""
        for watcher in watchers:
            watcher.take_scene(iteration, snapshot)

    def _draw(self) -> None:
        """Render for a watcher that waits for a picture."""
        for watcher in self._watchers:
            camera = watcher.camera()
            if camera is None:
                continue
            try:
                with torch.no_grad():
                    output = self._capture.options.renderer(self._trainer.gaussians, camera)
            except (SplatError, MemoryError, torch.cuda.OutOfMemoryError) as error:
                watcher.take_picture(f"not drawn: {str(error) or 'out of memory'}")
            else:
                watcher.take_picture(output)


class Figures:
    """The loss, PSNR, number of Gaussians and speed of a training over time.

    Args:
        trainer: The trainer.
    """

    SLOWNESS = 0.3
    """Weight of the newest speed in the mean."""

    def __init__(self, trainer: Trainer) -> None:
        self.loss: float | None = None
        self.psnr: float | None = None
        self.photo_factor = 1.0
        self.speed: float | None = None  # images per second
        self.points: list[tuple[int, float | None, float | None, int]] = []
        self._apart, self._step = 1, 0  # number of measurements per point of the curves
        self._event: StepEvent | None = None
        self._since: tuple[float, int] | None = (time.perf_counter(), trainer.iteration)

    def note(self, event: StepEvent) -> None:
        """Keep the event of the newest step."""
        self._event = event

    def interrupted(self) -> None:
        """Leave the time until the next measurement out of the speed."""
        self._since = None

    def measure(self, trainer: Trainer) -> None:
        """Measure loss, PSNR and speed now. Reading the loss synchronises with a GPU."""
        if self._event is None:
            return
        now, iteration = time.perf_counter(), trainer.iteration
        self.loss, self.psnr = without_nan(self._event.loss), _psnr(trainer)
        self.photo_factor = self._event.photo_factor
        if self._since is not None and iteration > self._since[1]:
            speed = (iteration - self._since[1]) / max(now - self._since[0], 1e-9)
            self.speed = speed if self.speed is None else self.speed + self.SLOWNESS * (speed - self.speed)
        self._since = now, iteration
        if self.points and self.points[-1][0] == iteration:
            return
        if self._step % self._apart == 0:
            self.points.append((iteration, self.loss, self.psnr, len(trainer.gaussians)))
        self._step += 1
        if len(self.points) > MOST_POINTS:
            self.points, self._apart = self.points[::2], 2 * self._apart


def state_of(
    trainer: Trainer, figures: Figures, state: str, seconds: float, failure: str = ""
) -> dict[str, Any]:
    """Describe a training for its watchers.

        state         "training", "paused", "evaluating" or "finished"
        iteration     images trained on, of `iterations`
        count         Gaussians, of at most `max_count`; null without a limit
        loss, psnr    of the last photo `photo`, whose size was `width` x `height` px, 1 / `photo_factor` of the full
                      one; null if unknown
        seconds       of training so far; a pause does not count
        seconds_left  until the last iteration at the present speed; null if unknown
        failure       why the last scene could not be made; empty if it could
        history       at most `MOST_POINTS` points of the curves so far: lists iteration, loss, psnr and count
        time          Unix time of this state

    What a page receives has `version` as well, a number that rises with each state. In a file there are two more:
    `scene`, the iteration of scene.bin (-1: none), and `pid`, the number of the training's process.

    Args:
        trainer: The trainer.
        figures: Its figures so far.
        state: What it does.
        seconds: Seconds of training so far.
        failure: Why the last scene could not be made.
    """
    total, cap = trainer.config.iterations, trainer.config.max_gaussians
    left = None
    if figures.speed and state in ("training", "paused"):
        left = round((total - trainer.iteration) / figures.speed, 1)
    shape = (0, 0, 3) if trainer.last is None else trainer.last[0].shape
    columns = list(zip(*figures.points, strict=True)) or [(), (), (), ()]
    return {
        "state": state,
        "iteration": trainer.iteration,
        "iterations": total,
        "count": len(trainer.gaussians),
        "max_count": cap,
        "loss": figures.loss,
        "psnr": figures.psnr,
        "photo": trainer.last_name,
        "width": shape[1],
        "height": shape[0],
        "photo_factor": figures.photo_factor,
        "seconds": round(seconds, 1),
        "seconds_left": left,
        "failure": failure,
        "history": dict(zip(("iteration", "loss", "psnr", "count"), columns, strict=True)),
        "time": round(time.time(), 3),
    }


def snapshot_of(trainer: Trainer) -> bytes:
    """Return a training's Gaussians as the bytes of scene.bin; those that are NaN or infinite are left out.

    Only the harmonics that the training uses so far are included.
    """
    degree = min(sh_degree(trainer.config, trainer.iteration), trainer.gaussians.sh_degree)
    shown = trainer.gaussians.map(lambda tensor: tensor.detach())
    shown = Gaussians(**{**shown.tensors(), "sh_rest": shown.sh_rest[:, : (degree + 1) ** 2 - 1]})
    if not _all_finite(shown):
        rows = shown.finite_rows()
        shown = shown.map(lambda tensor: tensor[rows])
    return framed(trainer.iteration, len(shown), degree, page_data.packed(shown))


def page_facts(capture: CaptureRun) -> dict[str, Any]:
    """Return the facts of the page that shows a training."""
    options, dataset = capture.options, capture.dataset
    views = sorted(
        ((view.name, view.camera) for view in (*dataset.train, *dataset.test)), key=lambda view: view[0]
    )
    held_out = {view.name for view in dataset.test}
    title, settings = options.out.resolve().name, options.render_settings
    return live_facts(title, views, held_out, dataset.points, settings, dataset.origin.tolist())


def _all_finite(gaussians: Gaussians) -> bool:
    """Return whether all values are finite; false negatives are possible, where a sum overflows."""
    return all(math.isfinite(float(tensor.abs().sum())) for tensor in gaussians.tensors().values())


def _psnr(trainer: Trainer) -> float | None:
    try:
        return None if trainer.last is None else without_nan(psnr(*trainer.last))
    except SplatError:  # an image with NaN or infinity has no PSNR
        return None

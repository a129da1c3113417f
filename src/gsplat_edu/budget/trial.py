"""Trials for a forecast: a few steps of a training, timed, whose result is discarded."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.ops.noise import NoiseNumbers
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import Extra, RenderOutput
from gsplat_edu.render.resident import ResidentRun, RunRules, RunState, RunSums, RunTarget
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import BY_NAME, TrainConfig
from gsplat_edu.train.density.surgery import split_children
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.part import flat_name, parts
from gsplat_edu.train.resident import leaves_device
from gsplat_edu.train.trainer import Trainer

TIMED_STEPS = 8
TRIAL_SECONDS = 1.5
"""A trial ends after this many timed steps or seconds, but not before its second timed step."""

GROWN_LIMITS = (125_000, 250_000)
"""Largest number of Gaussians that the start scene is grown to: by several doublings, and by a single one."""


@dataclass(frozen=True)
class Trial:
    """Measurements of a few steps.

    Args:
        gaussians: Number of Gaussians.
        pixels: Mean number of pixels of a view.
        pairs: Largest number of pairs in a view.
        seconds: Duration of each timed step.
        exchange: Seconds to read the state from a device and to send it back; 0 without one.
    """

    gaussians: int
    pixels: float
    pairs: int
    seconds: list[float]
    exchange: float


def grown_scene(start: Gaussians, wanted: int) -> Gaussians:
    """Split every Gaussian until there are about as many as wanted; their total area in the image is unchanged."""
    generator = torch.Generator().manual_seed(0)
    most = GROWN_LIMITS[1]
    while 2 * len(start) <= min(most, 1.5 * wanted):
        parts = [split_children(start, math.sqrt(2.0), generator) for _ in range(2)]
        start, most = Gaussians.concatenated(parts), GROWN_LIMITS[0]
    half = torch.zeros_like(start.logit_opacities)
    return Gaussians(**(start.tensors() | {"logit_opacities": half}))


def run_trial(
    gaussians: Gaussians, views: Sequence[View], config: TrainConfig, extent: float, backend: Backend
) -> Trial:
    """Train for a few steps on the path that the training will take: on the backend's device, or through tensors.

    Steps that compile kernels or send photos are not timed: the first one, and on a device those of the first round of
    the views and one more.

    Args:
        gaussians: The scene; it is not changed.
        views: The views, in memory.
        config: The run.
        extent: Size of the scene.
        backend: The kernels.

    Raises:
        BackendUnavailableError: the device fails.
    """
    pairs, moments, runs = [0], list[float](), list[_CountedRun]()
    make_run = None if leaves_device(config, {}) else backend.resident

    def counting(
        gaussians: Gaussians, camera: Camera | CameraTensors, settings: RenderSettings, extra: Extra
    ) -> RenderOutput:
        output = backend.rasterize(gaussians, camera, settings, extra)
        pairs.append(output.num_pairs or 0)
        return output

    def counted(harmonics: int, photo_room: int | None = None) -> ResidentRun:
        assert make_run is not None
        runs.append(_CountedRun(make_run(harmonics, photo_room)))
        return runs[-1]

    def note(trainer: Trainer, event: Event) -> None:
        if isinstance(event, StepEvent):
            if backend.device.type == "cuda":
                torch.cuda.synchronize()
            moments.append(time.perf_counter())

    untimed = 1 if make_run is None else len(views) + 1
    trainer = training(
        without_changes(config, untimed + TIMED_STEPS, len(gaussians)),
        Views(views),
        replace(backend, rasterize=counting, resident=None if make_run is None else counted),
        Start(gaussians, extent=extent),
        callbacks=[note],
        fused=config.batch == 1,  # a batch stores its gradients
    )
    trainer.run(_until(moments, untimed))
    pixels = float(np.mean([view.camera.W * view.camera.H for view in views]))
    exchange = sum(_exchange_seconds(run) for run in runs)
    most = max(pairs) if not runs else runs[0].most_pairs()
    return Trial(len(gaussians), pixels, most, np.diff(moments[untimed - 1 :]).tolist(), exchange)


def without_changes(config: TrainConfig, steps: int, gaussians: int) -> TrainConfig:
    """Return a configuration of so many steps at full size that changes no density, without what is not timed."""
    untimed = {flat_name(part, name) for part, each in parts().items() for name in each.untimed}
    return config.changed(
        iterations=steps,
        batch=1,
        sh_every=0,
        densify_start=steps,
        densify_stop=steps + 1,
        reset_every=0,
        fast_start_factor=1.0,
        fast_stop=steps + 1,
        max_gaussians=max(gaussians, config.max_gaussians or 0),
        **{name: BY_NAME[name].default for name in untimed},
    )


def _until(moments: Sequence[float], untimed: int) -> Callable[[], bool]:
    return lambda: len(moments) >= untimed + 2 and moments[-1] - moments[untimed - 1] > TRIAL_SECONDS


def _exchange_seconds(run: ResidentRun) -> float:
    """Return the seconds to read the state of a training from its device and to send it back."""
    state = run.read()
    began = time.perf_counter()
    run.load(state)
    run.read()  # a device may put off what is sent until something is read
    return time.perf_counter() - began


class _CountedRun:
    """A training on a device whose pairs are counted; see `ResidentRun`.

    Args:
        run: The training.
    """

    def __init__(self, run: ResidentRun) -> None:
        self._run, self._sums = run, list[Callable[[], RunSums]]()

    def most_pairs(self) -> int:
        """Wait for all steps, and return the most pairs of one."""
        return max(sums().pairs for sums in self._sums)

    def load(self, state: RunState) -> None:
        """Begin with this state."""
        self._run.load(state)

    def read(self) -> RunState:
        """Wait for all steps, and return the state."""
        return self._run.read()

    def image(self) -> Tensor:
        """Wait for all steps, and return the last one's image."""
        return self._run.image()

    def step(
        self,
        camera: Camera,
        settings: RenderSettings,
        target: RunTarget,
        rates: Mapping[str, AdamNumbers],
        rules: RunRules,
    ) -> Callable[[], RunSums]:
        """Take a step, and keep what waits for its sums."""
        self._sums.append(self._run.step(camera, settings, target, rates, rules))
        return self._sums[-1]

    def add_noise(self, numbers: NoiseNumbers, rules: RunRules) -> None:
        """Move the means at random."""
        self._run.add_noise(numbers, rules)


def halved(view: View) -> View:
    """Return a view of half the size, made of every second pixel, because only the time of a step matters."""
    camera, photo = view.camera, view.read()
    image, alpha, mask = (
        None if plane is None else np.ascontiguousarray(plane[::2, ::2])
        for plane in (photo.image, photo.alpha, photo.mask)
    )
    H, W = -(-camera.H // 2), -(-camera.W // 2)
    assert image is not None  # every photo has an image
    small = camera.scaled(W, H)
    return View(small, image, alpha=alpha, mask=mask)

"""Measure this machine's current speed by training for a few seconds; the result is discarded."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.budget.costs import Measurements, Speed, expected_counts
from gsplat_edu.data.dataset import Dataset, scene_extent
from gsplat_edu.evaluate.images import save_png, side_by_side
from gsplat_edu.evaluate.metrics import ImageScore, score_views
from gsplat_edu.evaluate.report import Picture
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of, load_backend
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import Extra, RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.surgery import split_children
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.schedule import photo_factor
from gsplat_edu.train.trainer import Trainer

Bytes = UInt8[np.ndarray, "H W 3"]

PROBE_STEPS = 9
PROBE_SECONDS = 1.5
"""A trial ends after this many steps or seconds, but not before its third step. Its first step is not timed."""

SMALLEST_HALVED_SIDE = 32
"""Views are halved for a trial only if their sides are at least this long afterwards, px."""

PAIRS_MARGIN = 1.2
"""Factor on the measured pairs: views that were not measured may have more. The views of fox differ by 11 %."""

GROWN_LIMITS = (125_000, 250_000)
"""Largest number of Gaussians that the start scene is grown to: by several doublings, and by a single one."""

ASSUMED_BYTES = 400 * 2**20
"""Assumed bytes of a process that has loaded torch, if the system does not report them."""


def resident_bytes() -> int:
    """Return the resident memory of this process, bytes; its peak if unknown, or else `ASSUMED_BYTES`."""
    try:
        for line in Path("/proc/self/status").read_text("ascii", errors="replace").splitlines():
            if line.startswith("VmRSS:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return ASSUMED_BYTES
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most


def return_freed_memory() -> None:
    """Return freed memory to the system if the C library supports it; by default it keeps memory for reuse."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # not the GNU C library
        ctypes.CDLL(None).malloc_trim(0)


def probe(
    dataset: Dataset, config: TrainConfig, backend: str = "cpu", scene: Gaussians | None = None
) -> Measurements:
    """Train for a few seconds and discard the result: with the start scene, with more Gaussians, and on small views.

    The larger scene is the start scene, split until it has about as many Gaussians as the run will have (or enough to
    measure the cost of one), with the higher opacity of trained Gaussians. A start scene that is already large is
    compared with half of it. Times depend on the current load and differ between probes.

    Args:
        dataset: The capture; a few of its photos are read.
        config: The run; its cap is respected.
        backend: Name of the rendering backend.
        scene: Gaussians that the run starts from; None to start from the points of the capture.

    Raises:
        ArgumentError: the backend has no forecast: the dense one, which takes minutes per iteration of a capture, or
            webgpu, whose memory is not in the model.
        DatasetError: a photo cannot be read.
    """
    if "forecast" in load_backend(backend).lacks:
        raise ArgumentError(f"backend: {backend} has no forecast; choose cpu or cuda")
    resident, views = resident_bytes(), _spread(dataset.train, 4)
    reading, photos = [], []
    for view in views:
        began = time.perf_counter()
        photo = view.read()
        reading.append(time.perf_counter() - began)
        photos.append(View(view.camera, photo.image, alpha=photo.alpha, mask=photo.mask, name=view.name))
    # mcmc starts with fainter and smaller Gaussians than it has later
    plain = replace(config, strategy="none")
    start, usual = (
        scene or from_points(dataset.points, dataset.colors, settings) for settings in (config, plain)
    )
    pixels = sum(view.camera.W * view.camera.H for view in dataset.train) / len(dataset.train)
    grown = _grown(usual, int(expected_counts(config, len(start), pixels)[-1]))
    if len(grown) == len(start) > 1:
        start = start.map(lambda tensor: tensor[::2])
    extent = scene_extent([view.camera for view in dataset.train])
    trial = functools.partial(_trial, config=config, extent=extent, name=backend)
    small = [_halved(view) for view in photos]
    trials = [trial(start, photos), trial(grown, photos)]
    if min(min(view.camera.W, view.camera.H) for view in small) >= SMALLEST_HALVED_SIDE:
        trials.append(trial(start, small))
    score, picture = scoring_seconds(grown, photos[:2], config, backend)
    pairs = _pairs_at_first(config, trials[0].pairs * len(usual) / len(start), len(usual))
    del start, usual, grown, small, photos
    return_freed_memory()
    return Measurements(
        backend=backend,
        speed=Speed.fitted([(t.gaussians, t.pixels, _median(t.seconds)) for t in trials]),
        read=_median(reading),
        score=score,
        picture=picture,
        pairs=pairs,
        resident=resident,
        settled=resident_bytes(),
        noise=math.sqrt(max(trials[0].seconds) / min(trials[0].seconds)),
    )


def _pairs_at_first(config: TrainConfig, pairs: float, gaussians: int) -> int:
    """Return the pairs of the start scene in photos of the size with which the run starts.

    The large Gaussians of a random start cover fewer tiles in reduced photos, and have shrunk before training uses the
    full size.

    Args:
        config: The run.
        pairs: Largest number of pairs in one of the measured photos, at full size.
        gaussians: Number of Gaussians of the start scene; even a small Gaussian has a pair.
    """
    most = PAIRS_MARGIN * pairs
    return math.ceil(max(most / photo_factor(config, 0) ** 2, min(most, gaussians)))


@dataclass(frozen=True)
class _Trial:
    """Measurements of a few steps.

    Args:
        gaussians: Number of Gaussians.
        pixels: Mean number of pixels of a view.
        pairs: Largest number of pairs in a view.
        seconds: Duration of each step except the first.
    """

    gaussians: int
    pixels: float
    pairs: int
    seconds: list[float]


def _grown(start: Gaussians, wanted: int) -> Gaussians:
    """Split every Gaussian until there are about as many as wanted; their total area in the image is unchanged."""
    generator = torch.Generator().manual_seed(0)
    most = GROWN_LIMITS[1]
    while 2 * len(start) <= min(most, 1.5 * wanted):
        parts = [split_children(start, math.sqrt(2.0), generator) for _ in range(2)]
        start, most = Gaussians.concatenated(parts), GROWN_LIMITS[0]
    half = torch.zeros_like(start.logit_opacities)
    return Gaussians(**(start.tensors() | {"logit_opacities": half}))


def _trial(
    gaussians: Gaussians, views: Sequence[View], config: TrainConfig, extent: float, name: str
) -> _Trial:
    pairs, moments, backend = [0], list[float](), load_backend(name)

    def counting(
        gaussians: Gaussians, camera: Camera | CameraTensors, settings: RenderSettings, extra: Extra
    ) -> RenderOutput:
        output = backend.rasterize(gaussians, camera, settings, extra)
        pairs.append(output.num_pairs or 0)
        return output

    def note(trainer: Trainer, event: Event) -> None:
        if isinstance(event, StepEvent):
            if backend.device.type == "cuda":
                torch.cuda.synchronize()
            moments.append(time.perf_counter())

    plain = config.changed(
        iterations=PROBE_STEPS,
        batch=1,
        sh_every=0,
        densify_start=PROBE_STEPS,
        densify_stop=PROBE_STEPS + 1,
        reset_every=0,
        fast_start_factor=1.0,
        fast_stop=PROBE_STEPS + 1,
        max_gaussians=max(len(gaussians), config.max_gaussians or 0),
        **dict.fromkeys(("refine", "appearance", "transients", "sky"), "none"),
    )
    trainer = training(
        plain,
        Views(views),
        replace(backend, rasterize=counting),
        Start(gaussians, extent=extent),
        callbacks=[note],
        fused=config.batch == 1,  # a batch stores its gradients
    )
    trainer.run(_until(moments))
    pixels = float(np.mean([view.camera.W * view.camera.H for view in views]))
    return _Trial(len(gaussians), pixels, max(pairs), np.diff(moments).tolist())


def _until(moments: Sequence[float]) -> Callable[[], bool]:
    return lambda: len(moments) >= 3 and moments[-1] - moments[0] > PROBE_SECONDS


def _halved(view: View) -> View:
    """Return a view of half the size, made of every second pixel, because only the time of a step matters."""
    camera, photo = view.camera, view.read()
    image, alpha, mask = (
        None if plane is None else np.ascontiguousarray(plane[::2, ::2])
        for plane in (photo.image, photo.alpha, photo.mask)
    )
    H, W = -(-camera.H // 2), -(-camera.W // 2)
    assert image is not None  # every photo has an image
    small = Camera.posed(camera.R, camera.eye, camera.intrinsics.scaled(W, H))
    return View(small, image, alpha=alpha, mask=mask)


def scoring_seconds(
    gaussians: Gaussians,
    views: Sequence[View],
    config: TrainConfig,
    backend: str,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[float, float]:
    """Time the scoring of views at the end of a run.

    Args:
        gaussians: The scene; it is not changed.
        views: Views to score, at least one; the fastest one determines the result.
        config: Rendering settings.
        backend: Name of the rendering backend.
        clock: Returns seconds.

    Returns:
        Seconds per pixel to score a view, and to write the pictures of a test view.
    """
    settings = RenderSettings(
        config.background,
        config.sh_degree,
        config.antialiased,
        depth=False,
        jacobian_limit=config.jacobian_limit,
    )
    placed = gaussians.to(device_of(backend))
    renderer = functools.partial(render, settings=settings, backend=backend)
    drawing = list[float]()

    def draw(view: View, score: ImageScore, image: Bytes, truth: Bytes) -> None:
        began = clock()
        with tempfile.TemporaryDirectory() as folder:
            save_png(Path(folder) / "probe.png", side_by_side([image, truth]))
        Picture.of(view.name, image, truth)
        drawing.append((clock() - began) / (view.camera.W * view.camera.H))

    scoring = list[float]()
    for view in views:
        began = clock()
        score_views(placed, [view], renderer, config.background, draw)
        scoring.append((clock() - began) / (view.camera.W * view.camera.H))
    if not drawing:  # masks exclude every pixel of these views
        return min(scoring), 0.0
    return max(min(scoring) - min(drawing), 0.0), min(drawing)


def _spread(views: Sequence[View], most: int) -> list[View]:
    count = min(len(views), most)
    return [views[i * len(views) // count] for i in range(count)]


def _median(values: Sequence[float]) -> float:
    return float(np.median(values))

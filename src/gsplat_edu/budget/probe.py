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
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.budget.costs import Measurements, Speed, expected_counts
from gsplat_edu.budget.trial import grown_scene, halved, run_trial
from gsplat_edu.data.dataset import Dataset, scene_extent
from gsplat_edu.engine.room import Room
from gsplat_edu.evaluate.images import save_png, side_by_side
from gsplat_edu.evaluate.metrics import ImageScore, score_views
from gsplat_edu.evaluate.report import Picture
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.backends import device_of, load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.schedule import photo_factor

Bytes = UInt8[np.ndarray, "H W 3"]

SMALLEST_HALVED_SIDE = 32
"""Views are halved for a trial only if their sides are at least this long afterwards, px."""

PAIRS_MARGIN = 1.2
"""Factor on the measured pairs: views that were not measured may have more. The views of fox differ by 11 %."""

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
        ArgumentError: the backend has no forecast: the dense one, which takes minutes per iteration of a capture.
        BackendUnavailableError: the backend's device fails.
        DatasetError: a photo cannot be read.
    """
    kernels, room = _ready(backend)
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
    grown = grown_scene(usual, int(expected_counts(config, len(start), pixels)[-1]))
    if len(grown) == len(start) > 1:
        start = start.map(lambda tensor: tensor[::2])
    extent = scene_extent([view.camera for view in dataset.train])
    trial = functools.partial(run_trial, config=config, extent=extent, backend=kernels)
    small = [halved(view) for view in photos]
    trials = [trial(start, photos), trial(grown, photos)]
    if min(min(view.camera.W, view.camera.H) for view in small) >= SMALLEST_HALVED_SIDE:
        trials.append(trial(start, small))
    score, picture = scoring_seconds(grown, photos[:2], config, backend)
    pairs = pairs_at_first(config, trials[0].pairs * len(usual) / len(start), len(usual))
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
        exchange=trials[1].exchange / trials[1].gaussians,
        room=room,
    )


def _ready(backend: str) -> tuple[Backend, Room | None]:
    """Return the kernels, and start their device, so that its driver counts as part of the process."""
    kernels = load_backend(backend)
    if "forecast" in kernels.lacks:
        raise ArgumentError(f"backend: {backend} has no forecast; choose cpu, cuda or webgpu")
    return kernels, None if kernels.room is None else kernels.room()


def pairs_at_first(config: TrainConfig, pairs: float, gaussians: int) -> int:
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

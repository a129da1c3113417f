"""Refines levels of detail against photos, and scores each at the size at which it is shown.

Level k has 2^-k of the splats. In photos reduced by f = 2^(k/2), one of its splats covers as many pixels as a splat of
the finest level covers at full size. A level is shown at this size, and trained and scored on the capture's photos
reduced by f. The number of splats and the leaf of each splat stay the same.

A scene without photos is compared with renders of itself from an orbit, likewise reduced; every fourth is held out.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.io.lod.levels import Node, leaves_of, level_of, with_levels
from gsplat_edu.parts.run_values import Compared
from gsplat_edu.paths.orbits import resized
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of, load_backend
from gsplat_edu.runs.dataset import data_settings, run_dataset
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.parts import stored_config
from gsplat_edu.runs.source import Source, run_of
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import FROM_SCENE, recipe
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Trainer

MOST_JUDGED = 8
"""Largest number of views that a level is scored on."""

ORBIT, ORBIT_SIDE, EVERY = 32, 640, 4
"""For a scene without photos: number of rendered views, their longer side in px, and hold out every n-th."""

LARGEST_FACTOR = 31.0
"""Largest factor by which photos are reduced; `DataSettings.resolution` takes values from 32 on as a side."""

FINEST_SIDE = 32.0
"""Reduced photos keep a longer side of at least this, px: the smallest value that `DataSettings.resolution` takes as a
side."""


@dataclass(frozen=True)
class LevelScore:
    """How well a level matches photos at the size at which it is shown.

    Args:
        level: The level; 0 is the finest.
        count: Its splats.
        factor: By how much the photos are reduced.
        before: PSNR of the merged splats, dB.
        after: PSNR after refining, dB; for level 0, of the scene itself. A level that did not improve was left
            unchanged.
    """

    level: int
    count: int
    factor: float
    before: float
    after: float

    def line(self, against: str) -> str:
        """Describe the score in one line.

        Args:
            against: What it was compared with.
        """
        size = f"{against} reduced by {self.factor:.3g}" if self.level else against
        found = f"{self.before:.2f} dB, refined {self.after:.2f} dB" if self.level else f"{self.after:.2f} dB"
        if self.level and self.after <= self.before:
            found += ", so it stays as merged"
        return f"level {self.level}, {self.count:,} splats, against {size}: {found}"


Split = tuple[Sequence[View], Sequence[View]]
"""Views to train on and views to score on."""


def refine_levels(
    source: Source, root: Node, steps: int, backend: str, say: Callable[[str], None]
) -> tuple[Node, list[LevelScore]]:
    """Train every level but the finest for a short time, without density control, and score all levels.

    A level whose score on held-out views does not improve is left unchanged.

    Args:
        source: The scene that the levels were made from; a run, or a scene without photos.
        root: The tree with the levels.
        steps: Iterations per level.
        backend: Backend of the renders.
        say: Called with a line per level.

    Returns:
        The tree with the refined levels, and the scores, finest first.

    Raises:
        CheckpointError: the run is damaged, or its capture is gone.
        DatasetError: a photo cannot be read.
    """
    run = run_of(source.path)
    leaves = leaves_of(root)
    against = "renders of the scene" if run is None else "the photos"
    changed: dict[int, list[Gaussians]] = {}
    scores = []
    for level in range(len(leaves[0].levels)):
        factor = min(2.0 ** (level / 2), LARGEST_FACTOR)
        views = (
            _renders(source, factor, backend) if run is None else photos_of_run(source, run, factor, backend)
        )
        merged = level_of(root, level)
        before = after = _score(source, merged, views[1] or views[0], backend)
        if level:
            refined = retrained(source, merged, views[0], steps, backend)
            after = _score(source, refined, views[1] or views[0], backend)
            if after > before:
                changed[level] = _split(refined, [len(leaf.levels[level]) for leaf in leaves])
        scores.append(LevelScore(level, len(merged), factor, before, after))
        say(scores[-1].line(against))
    return with_levels(root, changed), scores


def _split(gaussians: Gaussians, sizes: Sequence[int]) -> list[Gaussians]:
    ends = np.cumsum(sizes).tolist()
    return [
        gaussians.map(lambda t, begin=end - size, end=end: t[begin:end])  # type: ignore[misc]
        for size, end in zip(sizes, ends, strict=True)
    ]


def photos_of_run(
    source: Source, run: RunFolder, factor: float, backend: str, capture: Path | None = None
) -> Split:
    """Return a run's photos, reduced, at the cameras and the exposure of its scene.

    Args:
        source: The scene.
        run: Its run.
        factor: By how much they are reduced.
        backend: What renders the scene to compare exposures.
        capture: Where the photos are now; None for where they were.

    Raises:
        CheckpointError: the run is damaged, or does not say where its capture is.
        DatasetError: the capture cannot be read.
    """
    config = run.read_config()
    settings = data_settings(config)
    reduced = replace(settings, resolution=_reduced(settings.resolution, factor))
    config["data"] = {**config["data"], "resolution": reduced.resolution}
    dataset = run_dataset(config, capture)
    known = dict(source.cameras)
    train, test = (
        tuple(view.with_camera(_posed(view.camera, known.get(view.name))) for view in views)
        for views in (dataset.train, dataset.test)
    )
    dataset = replace(dataset, train=train, test=spread(test))
    shown = source.scene.gaussians.to(device_of(backend))
    dataset = Compared(dataset, shown, source.settings, load_backend(backend)).photos(stored_config(config))
    return dataset.train, dataset.test


def _reduced(resolution: float | None, factor: float) -> float:
    """Return the setting for photos reduced by a further factor; see `DataSettings.resolution`."""
    if resolution is None or resolution < FINEST_SIDE:
        return min((resolution or 1.0) * factor, LARGEST_FACTOR)
    return max(FINEST_SIDE, resolution / factor)


def _posed(camera: Camera, known: Camera | None) -> Camera:
    """Return a camera with the pose that its run learned."""
    return camera if known is None else Camera.posed(known.R, known.eye, camera.intrinsics, camera.shutter)


def spread(views: Sequence[View]) -> tuple[View, ...]:
    """Return at most `MOST_JUDGED` views, evenly from all."""
    count = min(len(views), MOST_JUDGED)
    return tuple(views[i * len(views) // count] for i in range(count))


def _renders(source: Source, factor: float, backend: str) -> Split:
    """Return renders of the scene from an orbit, reduced from full size."""
    shown = source.scene.gaussians.to(device_of(backend))
    views = []
    for name, camera in source.probes(ORBIT, ORBIT_SIDE):
        side = max(FINEST_SIDE, max(camera.W, camera.H) / factor)
        small = resized(camera, round(side))
        with torch.no_grad():
            image = render(shown, small, settings=source.settings, backend=backend).image
        pixels = np.rint(255.0 * image.clamp(0, 1).double().numpy(force=True)).astype(np.uint8)
        views.append(View(small, pixels, name=name))
    held = [view for i, view in enumerate(views) if i % EVERY == 0]
    return [view for i, view in enumerate(views) if i % EVERY], held


def retrained(
    source: Source,
    gaussians: Gaussians,
    views: Sequence[View],
    steps: int,
    backend: str,
    progress: Callable[[], object] = lambda: None,
) -> Gaussians:
    """Train splats that stand for a scene, without density control.

    Args:
        source: The scene: its render settings are those of the training.
        gaussians: The splats, relative to the scene's origin.
        views: The photos.
        steps: Iterations.
        backend: What trains.
        progress: Called after every step.

    Returns:
        As many splats in the same order, on the CPU.
    """
    settings = source.settings
    changes: dict[str, Any] = {**FROM_SCENE}
    config = recipe(
        steps,
        strategy="none",
        **changes,
        sh_degree=gaussians.sh_degree,
        max_gaussians=None,
        background=tuple(float(x) for x in settings.background),
        antialiased=settings.antialiased,
        jacobian_limit=settings.jacobian_limit,
    )
    trainer = training(config, Views(views), load_backend(backend), Start(gaussians))

    def stepped(trainer: Trainer, event: Event) -> None:
        if isinstance(event, StepEvent):
            progress()

    trainer.run(callbacks=[stepped])
    return trainer.gaussians.map(lambda tensor: tensor.detach().cpu())


def _score(source: Source, gaussians: Gaussians, views: Sequence[View], backend: str) -> float:
    shown = functools.partial(render, settings=source.settings, backend=backend)
    with torch.no_grad():
        scores = score_views(
            gaussians.to(device_of(backend)), spread(views), shown, source.settings.background
        )
    return float(summarize(scores)["psnr"] or 0.0)

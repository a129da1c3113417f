"""The refined cameras of a run: the capture with them, and the scores of held-out views whose poses are aligned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.alignment import TensorRenderer, aligned_psnr, mean_aligned_psnr
from gsplat_edu.parts.poses.refinement import Refinement
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import TrainConfig

FOLDER = "refined"
"""Name of the folder in the run's."""


def with_refined_cameras(refinement: Refinement, dataset: Dataset) -> Dataset:
    """Return the capture with the refined cameras of its training views, and refined intrinsics of its test views.

    The poses of test views are never refined.
    """
    train = [view.with_camera(refinement.refined(i, view.camera)) for i, view in enumerate(dataset.train)]
    test = [view.with_camera(refinement.with_refined_lens(view.camera)) for view in dataset.test]
    return replace(dataset, train=tuple(train), test=tuple(test))


def write_refined(run: Path, dataset: Dataset) -> Path:
    """Write and return RUN/refined: photos as trained on, as PNG, with the refined cameras in COLMAP's layout.

    Raises:
        OSError: a file cannot be written.
    """
    every = [
        View.stored(in_capture_frame(view.camera, dataset), view.read, name)
        for part in (dataset.train, dataset.test)
        for view, name in zip(part, png_names(part), strict=True)
    ]
    folder = run / FOLDER
    write_colmap(folder, every, dataset.points + dataset.origin, dataset.colors)
    return folder


def in_capture_frame(camera: Camera, dataset: Dataset) -> Camera:
    """Return a camera of the dataset in the capture's own coordinates."""
    return Camera.posed(camera.R, camera.eye + dataset.origin, camera.intrinsics, camera.shutter)


def png_names(views: Sequence[View]) -> list[str]:
    """Return the views' names with the ending .png added where they have another."""
    return [
        view.name if PurePosixPath(view.name).suffix.lower() == ".png" else f"{view.name}.png"
        for view in views
    ]


def aligned_score(
    views: Sequence[View],
    gaussians: Gaussians,
    config: TrainConfig,
    renderer: TensorRenderer,
    extent: float,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Score held-out views after their poses are aligned; return "psnr_aligned" for metrics.json; empty if none counts.

    Args:
        views: The held-out views.
        gaussians: The scene.
        config: The run's configuration.
        renderer: Renders a scene with the run's settings.
        extent: Size of the scene, world units.
        say: Receives a sentence with the score.
    """
    colors, background = config.corrects_colors, config.background
    scores = [aligned_psnr(gaussians, view, renderer, background, extent, colors=colors) for view in views]
    mean = mean_aligned_psnr(scores)
    if mean is None:
        return {}
    what = "poses aligned and colours fitted" if colors else "poses aligned"
    say(
        f"held-out photos, {what} on every other square of a grid: {mean:.2f} dB PSNR on the remaining squares"
    )
    return {"psnr_aligned": round(mean, 4)}

"""The refined cameras of a run: the capture with them, and the scores of held-out views whose poses are aligned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.alignment import aligned_psnr, mean_aligned_psnr
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.poses import Refinement


def with_refined_cameras(refinement: Refinement, dataset: Dataset) -> Dataset:
    """Return the capture with the refined cameras of its training views, and refined intrinsics of its test views.

    The poses of test views are never refined.
    """
    train = [with_camera(view, refinement.refined(i, view.camera)) for i, view in enumerate(dataset.train)]
    test = [with_camera(view, refinement.with_refined_lens(view.camera)) for view in dataset.test]
    return replace(dataset, train=tuple(train), test=tuple(test))


def with_camera(view: View, camera: Camera) -> View:
    """Return a view with another camera."""
    return View.stored(camera, view.read, view.name)


def write_refined(folder: RunFolder, dataset: Dataset) -> None:
    """Write RUN/refined: the photos as they were trained on, as PNG, with the refined cameras in COLMAP's layout.

    Raises:
        OSError: a file cannot be written.
    """
    every = [
        View.stored(in_capture_frame(view.camera, dataset), view.read, name)
        for part in (dataset.train, dataset.test)
        for view, name in zip(part, png_names(part), strict=True)
    ]
    write_colmap(folder.refined, every, dataset.points + dataset.origin, dataset.colors)


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
    options: RunOptions,
    extent: float,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Score held-out views after their poses are aligned; return "psnr_aligned" for metrics.json; empty if none counts.

    Args:
        views: The held-out views.
        gaussians: The scene.
        options: Options of the run.
        extent: Size of the scene, world units.
        say: Receives a sentence with the score.
    """
    colors, background = options.config.appearance != "none", options.config.background
    scores = [
        aligned_psnr(gaussians, view, options.renderer, background, extent, colors=colors) for view in views
    ]
    mean = mean_aligned_psnr(scores)
    if mean is None:
        return {}
    what = "poses aligned and colours fitted" if colors else "poses aligned"
    say(
        f"held-out photos, {what} on every other square of a grid: {mean:.2f} dB PSNR on the remaining squares"
    )
    return {"psnr_aligned": round(mean, 4)}

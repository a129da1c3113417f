"""Start points for photos whose poses are known: features, matches, and triangulation with the poses held fixed.

Only training photos take part, as the dataset gives them: undistorted, at its size.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.points import read_points_ply
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.scene.views import View
from gsplat_edu.sfm import pairs
from gsplat_edu.sfm.colmap import COLMAP_SEED, call

LONGEST_SIDE, MAX_FEATURES = 1_000, 4_000
"""Size of the photos in which features are found, px, and features of each."""

NEIGHBOURS = 10
"""Each photo is matched with this many whose place and direction are most alike."""

LEAST_POINTS = 500
"""Fewer triangulated points do not outline a scene; random points are the better start."""

STAGES = ("features", "matches", "points")
"""Stages of a triangulation, for progress."""

RESULT = "points.ply"
"""File of the points in the work folder."""

Progress = Callable[[str, int, int], None]
"""Called with a stage of `STAGES`, the amount done and the total."""


def triangulate(
    views: Sequence[View],
    folder: Path,
    progress: Progress = lambda stage, done, total: None,
    threads: int = -1,
) -> Cloud | None:
    """Triangulate points of the scene from photos with known poses. Poses and intrinsics stay as they are.

    The points have the same bits for any number of threads.

    Args:
        views: Training views, at least two.
        folder: A work folder; it is made, and removed in the end.
        progress: Called with a stage of `STAGES`, the amount done and the total.
        threads: Threads of COLMAP; -1 for all.

    Returns:
        The points, in the cameras' coordinates, with colours; None if there are fewer than `LEAST_POINTS`.

    Raises:
        ArgumentError: pycolmap is not installed.
        DatasetError: a photo cannot be read, or COLMAP failed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("photos", "masks"):
        (folder / name).mkdir(parents=True)
    try:
        count = _triangulated(views, folder, progress, threads)
        progress(STAGES[2], 1, 1)
        return None if count < LEAST_POINTS else read_points_ply(folder / RESULT)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _triangulated(views: Sequence[View], folder: Path, progress: Progress, threads: int) -> int:
    """Write the triangulated points into a folder; return their number."""
    facts = [_write_photo(folder, number, view) for number, view in enumerate(views, 1)]
    chosen, listed = _pairs(views), folder / "pairs.txt"
    listed.write_text("".join(f"{facts[i]['name']} {facts[j]['name']}\n" for i, j in sorted(chosen)), "utf-8")
    photos = str(folder / "photos")
    groups = [
        {"names": [fact["name"]], "width": fact["W"], "height": fact["H"], "focal": fact["fx"]}
        for fact in facts
    ]

    def run(job: str, stage: str, total: int, **arguments: object) -> dict[str, Any]:
        database, log = str(folder / "database.db"), folder / "log.txt"
        return call(job, log, lambda done: progress(stage, done, total), database=database, **arguments)

    common = {"threads": threads, "seed": COLMAP_SEED}
    alone = common | {"threads": 1}
    run("pinholes", STAGES[0], len(views), views=facts)
    features = {
        "photos": photos,
        "masks": str(folder / "masks"),
        "groups": groups,
        "sift": {"max_num_features": MAX_FEATURES},
    }
    run("features", STAGES[0], len(views), **features, **common)
    # On one thread: with several, once in many runs a point more or less was found. The order of the sums of the
    # triangulation depends on the threads, too. Features do not.
    run("matches", STAGES[1], len(chosen), pairs=str(listed), **alone)
    written = {"photos": photos, "out": str(folder / RESULT), "views": facts}
    return int(run("triangulation", STAGES[2], 1, **written, **alone)["points"])


def _write_photo(folder: Path, number: int, view: View) -> dict[str, object]:
    """Write a view's photo and mask as PNG, reduced to `LONGEST_SIDE`; return name, size, intrinsics and pose."""
    camera, factor = view.camera, max(1.0, max(view.camera.W, view.camera.H) / LONGEST_SIDE)
    W, H = max(round(camera.W / factor), 1), max(round(camera.H / factor), 1)
    photo, name = view.read().scaled(W, H), f"{number:05d}.png"
    image = photo.image if photo.image.dtype == np.uint8 else np.round(255 * photo.image).astype(np.uint8)
    Image.fromarray(np.ascontiguousarray(image)).save(folder / "photos" / name)
    counts = np.ones((H, W), dtype=bool) if photo.mask is None else photo.mask
    counts = counts if photo.alpha is None else counts & (photo.alpha > 0)
    Image.fromarray((255 * counts).astype(np.uint8)).save(folder / "masks" / f"{name}.png")
    K = camera.intrinsics.scaled(W, H)
    R = np.asarray(camera.R)
    return {
        "name": name,
        "W": W,
        "H": H,
        # COLMAP puts the centre of the first pixel at (0.5, 0.5)
        "fx": float(K.fx),
        "fy": float(K.fy),
        "cx": float(K.cx) + 0.5,
        "cy": float(K.cy) + 0.5,
        "rotation": R.tolist(),
        "translation": (-R @ np.asarray(camera.eye)).tolist(),
    }


def _pairs(views: Sequence[View]) -> set[pairs.Pair]:
    """Return pairs of views that look from similar places in similar directions."""
    cameras = [view.camera for view in views]
    if len(views) <= NEIGHBOURS + 1:
        return pairs.all_pairs(len(views))
    extent = scene_extent(cameras)
    alike = np.array([[*(np.asarray(camera.eye) / extent), *camera.R[2]] for camera in cameras])
    return pairs.nearest_pairs(alike, NEIGHBOURS)

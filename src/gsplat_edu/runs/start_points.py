"""Start points of a run: triangulated from the photos where a capture has none, or of a laser scan."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.text import install_command
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.dataset import Dataset, scene_extent
from gsplat_edu.data.point_files import PointFile, read_points
from gsplat_edu.data.points import Points, write_points_ply
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.visible_cloud import colored, seen_by, thinned
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.scene.camera import Camera
from gsplat_edu.sfm.triangulate import triangulate

NAME = "points.ply"
"""File of the triangulated points in a run's folder, in the capture's coordinates."""

MOST_POINTS = 500_000
"""Most points of a file that a run starts from; more are thinned evenly."""

LEAST_SEEN, LEAST_SHARE = 500, 0.01
"""If the photos see fewer points of a file, and a smaller share of them, it has other coordinates than the capture."""

FARTHEST = 1000.0
"""Points farther from the cameras than this multiple of the cameras' extent have other coordinates than the capture: a
photo may show their direction, but none their distance."""

CORE_SECONDS, TIME_SHARE = 3.0, 0.25
"""Expected processor time of a photo's features and matches, s, twice that of the machine of benchmarks/RESULTS.md; and
the largest share of a time limit that triangulation may take."""

Say = Callable[[str], None]
Progress = Callable[[str, int, int], None]


def with_start_points(
    options: RunOptions,
    reader: CaptureReader,
    say: Say = lambda sentence: None,
    progress: Progress = lambda stage, done, total: None,
    time_limit: float | None = None,
) -> RunOptions:
    """Make the start points that a capture lacks, or those of a scan, and keep them in the run's folder.

    Of a point cloud that is given, points that no photo sees are left out, the others thinned, and coloured by the
    photos if they have no colour; a PLY with colours and few points stays as it is, if photos see some of them. A LAS
    in another reference system is moved, if the capture says where on earth it is. Without one, points are
    triangulated if the capture has none. Only training photos take part. Without the extra `sfm`, or where photos match
    too little, the run starts from random points, and a sentence says so.

    Args:
        options: Options of the run.
        reader: The run's capture.
        say: Receives sentences for the user.
        progress: Called with a stage, the amount done and the total.
        time_limit: Seconds of the whole command; if points would take more than a quarter of them, none are
            triangulated.

    Returns:
        The options with the file as `points`; unchanged if there are points, or a scene to start from.

    Raises:
        DatasetError: the capture or one of its photos cannot be read, or COLMAP failed.
        OSError: the file cannot be written.
    """
    if options.scene is not None:
        return options
    stored = options.folder.path / NAME
    if options.folder.exists():  # to be resumed; without --resume, it is refused later
        return dataclasses.replace(options, points=stored) if stored.is_file() else options
    if options.points is not None:
        return _with_given(options, options.points, reader, stored, say)
    dataset = Dataset.of(reader, options.data_settings)
    if dataset.measured or len(dataset.train) < 2:
        return options
    if importlib.util.find_spec("pycolmap") is None:
        say(
            f"the capture has no points; {install_command('sfm')} lets train triangulate some from its photos"
        )
        return options
    if time_limit is not None and _expected_seconds(len(dataset.train)) > TIME_SHARE * time_limit:
        say("the time limit is too short to triangulate start points; the run starts from random ones")
        return options
    # At the size of the files, which `triangulate` reduces, and without keeping them in memory.
    settings = dataclasses.replace(options.data_settings, resolution=None, image_memory=0, lens="undistort")
    cloud = triangulate(Dataset.of(reader, settings).train, options.folder.path / "points", progress)
    if cloud is None:
        say("the photos match too little to triangulate start points from them")
        return options
    write_points_ply(stored, Cloud(cloud.points + dataset.origin, cloud.colors))
    say(
        f"triangulated {len(cloud.points):,} start points from the given poses; --points random starts without"
    )
    return dataclasses.replace(options, points=stored)


def _with_given(options: RunOptions, path: Path, reader: CaptureReader, stored: Path, say: Say) -> RunOptions:
    """Take over the points of a file, as far as training needs them."""
    found = read_points(path)
    settings = dataclasses.replace(options.data_settings, lens="undistort")
    dataset = Dataset.of(reader, settings)
    points, chosen, moved = _in_the_capture(path, found, dataset)
    if not (moved or found.scan or found.colors is None or len(points) > MOST_POINTS):
        return options
    chosen = chosen[thinned(points[chosen], MOST_POINTS)]
    points = points[chosen]
    colors = colored(points, dataset.train) if found.colors is None else found.colors[chosen]
    stored.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(stored) as aside:
        write_points_ply(aside, Cloud(points + dataset.origin, colors))
    taken = (
        f"{path}: training starts from {len(points):,} of {len(found.points):,} points that the photos see"
    )
    say(taken + moved + (", coloured by the photos" if found.colors is None else ""))
    return dataclasses.replace(options, points=stored)


def _in_the_capture(
    path: Path, found: PointFile, dataset: Dataset
) -> tuple[Points, Int64[np.ndarray, " M"], str]:
    """Return the points relative to the dataset's origin, those that training photos see, and whence they were moved.

    They are taken as they are if photos see them. Otherwise they are moved if their file and the capture say where on
    earth they are.
    """
    points, moved, cameras = found.points - dataset.origin, "", [view.camera for view in dataset.train]
    enough = min(LEAST_SEEN, LEAST_SHARE * len(points))
    chosen = _seen(points, cameras)
    earth = None if dataset.scale is None else dataset.scale.earth
    if len(chosen) < enough and found.crs and earth:
        try:
            points = earth.positions_of(found.points, found.crs) - dataset.origin
        except ArgumentError as error:
            raise DatasetError(f"--points: {path}: {error}") from None
        moved = f", moved from {found.crs} to the capture's coordinates"
        chosen = _seen(points, cameras)
    if len(chosen) < enough:
        middle = ", ".join(f"{x:.6g}" for x in np.nanmedian(points + dataset.origin, axis=0))
        raise DatasetError(
            f"--points: {path}: the photos see {len(chosen):,} of {len(points):,} points, whose middle is at"
            f" ({middle}){moved}; bring them into the coordinates of the capture's poses"
        )
    return points, chosen, moved


def _seen(points: Points, cameras: Sequence[Camera]) -> Int64[np.ndarray, " M"]:
    """Return which points lie in the image of some camera, and not absurdly far away."""
    middle = np.mean([camera.eye for camera in cameras], axis=0)
    is_near = np.linalg.norm(points - middle, axis=1) <= FARTHEST * scene_extent(cameras)
    return np.flatnonzero(seen_by(points, cameras, least=1) & is_near)


def _expected_seconds(photos: int) -> float:
    return CORE_SECONDS * photos / (os.cpu_count() or 1)

"""Start points for a capture that has poses but no points: triangulated from its photos where COLMAP is installed."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
from collections.abc import Callable

from gsplat_edu.base.text import install_command
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.points import write_points_ply
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.sfm.triangulate import triangulate

NAME = "points.ply"
"""File of the triangulated points in a run's folder, in the capture's coordinates."""

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
    """Triangulate start points if the capture has none, and keep them in the run's folder.

    Only training photos take part. Without the extra `sfm`, or where photos match too little, the run starts from
    random points, and a sentence says so.

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
    if options.points is not None or options.scene is not None:
        return options
    stored = options.folder.path / NAME
    if options.folder.exists():  # to be resumed; without --resume, it is refused later
        return dataclasses.replace(options, points=stored) if stored.is_file() else options
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


def _expected_seconds(photos: int) -> float:
    return CORE_SECONDS * photos / (os.cpu_count() or 1)

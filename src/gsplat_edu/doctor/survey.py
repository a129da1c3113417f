"""A capture prepared for examination: poses read, every photo looked at once, nothing refused before it is told."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsplat_edu.camera import Camera
from gsplat_edu.data.capture import PHOTO_ENDINGS, Capture, Frame, entries, is_folder, photo_file
from gsplat_edu.data.dataset import read_capture
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.notes import Note
from gsplat_edu.data.points import finite_cloud
from gsplat_edu.doctor.geometry import Geometry
from gsplat_edu.doctor.photos import Look, look_at_photo
from gsplat_edu.doctor.support import observed_points
from gsplat_edu.errors import DatasetError

WORKERS = 2
"""Photos decoded at once: each may take 40 MB for a moment, or all its pixels where it is no JPEG."""

Progress = Callable[[int, int], None]
"""Is told how many photos are done, and how many there are."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A photo that could be read, with its camera.

    Args:
        name: What the capture calls it.
        lens: Its camera as the capture states it.
        size: Width and height of the file, px.
        camera: The pinhole it becomes, at the size of the thumbnail.
        look: What was measured.
    """

    name: str
    lens: Lens
    size: tuple[int, int]
    camera: Camera
    look: Look


class Refused(NamedTuple):
    """A photo that cannot be used."""

    name: str
    """What the capture calls it."""
    reason: str
    """Why, in a few words: `DatasetError.reason`."""


@dataclass(frozen=True, eq=False)
class Survey:
    """What the checks look at.

    Args:
        path: The capture.
        layout: "COLMAP", "transforms.json" or "Blender".
        shots: Photos that could be read, sorted by name.
        refused: Photos that could not, sorted by name.
        unposed: Names of files in the folders of the photos that have no pose.
        points: (N, 3) the capture's own points, world units; none where it has none.
        notes: What the reader of the layout noted.
        observed: How many points were found in each photo, by the names of the shots; empty where nothing says so.
    """

    path: Path
    layout: str
    shots: tuple[Shot, ...]
    refused: tuple[Refused, ...]
    unposed: tuple[str, ...]
    points: Float64[np.ndarray, "N 3"]
    notes: tuple[Note, ...]
    observed: Mapping[str, int] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Names of the photos that could be read."""
        return [shot.name for shot in self.shots]

    @cached_property
    def geometry(self) -> Geometry:
        """What the cameras see; there has to be a shot."""
        return Geometry([shot.camera for shot in self.shots], self.points)


def prepare(path: Path, progress: Progress | None = None) -> Survey:
    """Read a capture and look at its photos, a few at a time.

    Args:
        path: Folder or transforms.json, as for `gsplat_edu.data.dataset.load_dataset`.
        progress: Is told how far it got, from the calling thread.

    Raises:
        DatasetError: nothing of that kind is there, or its poses cannot be read. A photo that cannot be is no error.
    """
    capture = read_capture(path)
    frames = sorted(capture.frames, key=lambda frame: frame.name)
    shots, refused = list[Shot](), list[Refused]()
    with ThreadPoolExecutor(WORKERS) as pool:
        try:
            for done, found in enumerate(pool.map(_shot, frames), 1):
                if isinstance(found, Shot):
                    shots.append(found)
                else:
                    refused.append(found)
                if progress is not None:
                    progress(done, len(frames))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return Survey(
        path,
        capture.layout,
        tuple(shots),
        tuple(refused),
        _unposed(capture),
        _points(capture),
        capture.notes,
        observed_points(path) if capture.layout == "COLMAP" else {},
    )


def _shot(frame: Frame) -> Shot | Refused:
    """Measure a photo, or return why it cannot be used."""
    try:
        source, camera, _ = photo_file(frame, None, (0.0, 0.0, 0.0))
        look = look_at_photo(source.path, source.lens, source.mask)
    except DatasetError as error:
        return Refused(frame.name, error.reason)
    h, w = look.thumbnail.shape[:2]
    small = Camera.posed(camera.R, camera.eye, camera.intrinsics.scaled(w, h))
    return Shot(frame.name, frame.lens, (camera.W, camera.H), small, look)


def _points(capture: Capture) -> Float64[np.ndarray, "N 3"]:
    if capture.cloud is None:
        return np.zeros((0, 3))
    return finite_cloud(capture.cloud)[0].points


def _unposed(capture: Capture) -> tuple[str, ...]:
    """List the photos beside those with a pose that have none themselves.

    Blender's scenes are left out: their poses were made with the photos, and depth maps lie beside these.
    """
    if capture.layout == "Blender":
        return ()
    posed = {frame.image.resolve() for frame in capture.frames}
    masks = {frame.mask.resolve() for frame in capture.frames if frame.mask is not None}
    folders = sorted({frame.image.parent for frame in capture.frames})
    return tuple(
        path.name for folder in folders for path in _photos(folder) if path.resolve() not in posed | masks
    )


def _photos(folder: Path) -> Sequence[Path]:
    if not is_folder(folder):
        return ()
    return [path for path in entries(folder) if path.suffix.lower() in PHOTO_ENDINGS and path.is_file()]

"""Reads a capture once, for all datasets that are derived from it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.plugins import plugins
from gsplat_edu.data.blender import TRAIN_FILE, read_blender
from gsplat_edu.data.capture import (
    PHOTO_ENDINGS,
    PHOTO_FOLDERS,
    Capture,
    Cloud,
    Frame,
    capture_folder,
    entries,
    is_file,
    is_folder,
)
from gsplat_edu.data.chosen_poses import chosen_poses
from gsplat_edu.data.colmap import PLACES, find_model, read_colmap
from gsplat_edu.data.conventions import read_as
from gsplat_edu.data.loading_notes import LoadingNote, MovedOrigin
from gsplat_edu.data.notes import TwoLayouts
from gsplat_edu.data.point_files import read_points
from gsplat_edu.data.points import finite_cloud
from gsplat_edu.data.readers.programs import PROGRAMS, pose_files, read_poses
from gsplat_edu.data.scale import read_scale
from gsplat_edu.data.transforms import read_transforms
from gsplat_edu.data.watch import FileWatch
from gsplat_edu.photos.decoding import PhotoHeaders
from gsplat_edu.scene.frame import origin_of


@dataclass(frozen=True, eq=False)
class PlacedCapture:
    """Frames and start points of a capture, moved to the origin if their coordinates are too large for float32.

    Args:
        frames: Sorted by name.
        cloud: Start points; None if there are none.
        origin: (3,) offset that was subtracted from all coordinates, world units.
        notes: Notes of the capture's reader, and about points that were left out or moved.
    """

    frames: tuple[Frame, ...]
    cloud: Cloud | None
    origin: Float64[np.ndarray, "3"]
    notes: tuple[LoadingNote, ...]


class CaptureReader:
    """Reads a capture once, when it is first needed: poses, names and points, and each photo's header.

    `gsplat_edu.data.dataset.Dataset.of` derives datasets from it, of any resolution, split, background and memory.
    They share the digests of the photos' files, so that a change of a photo between two datasets is detected.

    Args:
        path: A capture folder of COLMAP, nerfstudio, instant-ngp, Blender or a program of
            `gsplat_edu.data.readers.programs`; or a transforms.json or such a program's file.
        reading: Name of another reading of its poses and lenses, see `gsplat_edu.data.conventions`; None reads them as
            the format says.

    Attributes:
        path: The capture's path.
        reading: As given.
        headers: Headers of its photos and masks.
        watch: Digests of its photos and masks.
    """

    def __init__(self, path: str | Path, reading: str | None = None) -> None:
        self.path, self.reading = Path(path), reading
        self.headers, self.watch = PhotoHeaders(), FileWatch()
        self._placed: dict[Path | None, PlacedCapture] = {}

    @cached_property
    def capture(self) -> Capture:
        """The contents of the capture; see `read_capture`."""
        found = read_capture(self.path)
        return found if self.reading is None else read_as(found, self.reading)

    def under(self, reading: str | None) -> CaptureReader:
        """Return a reader of the same capture with another reading; itself for its own, and for None.

        Args:
            reading: As for the constructor.
        """
        if reading is None or reading == self.reading:
            return self
        other = CaptureReader(self.path, reading)
        other.headers, other.watch = self.headers, self.watch
        return other

    def placed(self, points: Path | None = None) -> PlacedCapture:
        """Return the sorted frames and the start points, near the origin.

        Args:
            points: A file that replaces the capture's start points, in its coordinates; see `read_points`. It is read
                once.

        Raises:
            DatasetError: the capture or the file cannot be read.
        """
        if points not in self._placed:
            capture = self.capture
            given = read_points(points).cloud if points else capture.cloud
            self._placed[points] = _near_origin(capture.frames, given, capture.notes)
        return self._placed[points]


def read_capture(path: Path) -> Capture:
    """Detect the layout of a path and read its poses and names, without photos.

    Of a folder with poses of several programs, those that were chosen (`gsplat_edu.data.chosen_poses`) come first.

    Raises:
        DatasetError: it holds no capture, or a damaged one.
    """
    if (foreign := _plugged_reader(path)) is not None:
        reader: Reader = plugins("readers")[foreign]
        return reader.read(path)
    path = chosen_poses(path)
    if is_file(path) and (model := find_model(path)) is not None:
        folder = capture_folder(path)
        return replace(read_colmap(folder, model), scale=read_scale(folder))
    if is_file(path) and (files := pose_files(path)):
        return read_poses(path, files)
    if path.suffix.lower() == ".json" and is_file(path):
        return read_blender(path.parent) if path.name == TRAIN_FILE else read_transforms(path)
    if not is_folder(path):
        raise DatasetError(f"{path}: is neither a folder nor a file with poses; give the folder of a capture")
    if is_file(path / TRAIN_FILE):
        return read_blender(path)
    model = find_model(path)
    if is_file(path / "transforms.json"):
        capture = read_transforms(path / "transforms.json")
        return capture if model is None else replace(capture, notes=(TwoLayouts(path), *capture.notes))
    if model is not None:
        return replace(read_colmap(path, model), scale=read_scale(path))
    if files := pose_files(path):
        return read_poses(path, files)
    places = ", ".join("the folder itself" if place == "." else place for place in PLACES)
    others = ", ".join(dict.fromkeys(program.name for program in PROGRAMS))
    looked = (
        f"{TRAIN_FILE}, transforms.json, cameras and images (.bin or .txt) in {places}, poses of {others}"
    )
    if _has_photos(path):
        raise DatasetError(
            f"{path}: holds photos but no camera poses; find the poses with "
            f"`gsplat-edu sfm {path} OUT` (looked for {looked})"
        )
    raise DatasetError(f"{path}: is not a capture; looked for {looked}")


def is_capture(path: Path) -> bool:
    """Return whether a folder has the files of a layout, or photos, which then lack poses.

    Args:
        path: The folder.
    """
    return layout_of(path) is not None or _has_photos(path)


def layout_of(path: Path) -> str | None:
    """Return the layout of a capture by its files: "Blender", "transforms.json", "COLMAP" or another program's name.

    A plug-in has the name of its reader.

    Args:
        path: The folder, or the capture's file.

    Returns:
        The layout that `read_capture` reads; None if there are no poses.
    """
    if (foreign := _plugged_reader(path)) is not None:
        return foreign
    with contextlib.suppress(DatasetError):  # reading says what is wrong with the choice
        path = chosen_poses(path)
    if is_file(path) and find_model(path) is not None:
        return "COLMAP"
    if is_file(path) and (files := pose_files(path)):
        return files[0].program.name
    if path.suffix.lower() == ".json" and is_file(path):
        return "Blender" if path.name == TRAIN_FILE else "transforms.json"
    for layout, name in (("Blender", TRAIN_FILE), ("transforms.json", "transforms.json")):
        if is_file(path / name):
            return layout
    if find_model(path) is not None:
        return "COLMAP"
    return next((found.program.name for found in pose_files(path)), None)


class Reader(Protocol):
    """Reads a layout of captures that a plug-in adds; see docs/PLUGINS.md."""

    def finds(self, path: Path) -> bool:
        """Return whether a path holds such a capture, by its names and first bytes."""
        ...

    def read(self, path: Path) -> Capture:
        """Read poses and names, without photos.

        Raises:
            DatasetError: the capture is damaged.
        """
        ...


def _plugged_reader(path: Path) -> str | None:
    """Return the name of the plug-in, a `Reader`, that reads a path; None if none does."""
    return next((name for name, reader in plugins("readers").items() if reader.finds(path)), None)


def _has_photos(path: Path) -> bool:
    folders = [folder for folder in (path, *(path / name for name in PHOTO_FOLDERS)) if is_folder(folder)]
    return any(file.suffix.lower() in PHOTO_ENDINGS for folder in folders for file in entries(folder))


def _near_origin(
    found: Sequence[Frame], cloud: Cloud | None, found_notes: Sequence[LoadingNote]
) -> PlacedCapture:
    """Sort frames by name, and move a scene whose coordinates are too large for float32, as on a map, to the origin."""
    frames, notes = sorted(found, key=lambda frame: frame.name), list(found_notes)
    if cloud is not None:
        cloud, note = finite_cloud(cloud)
        notes += [note] if note is not None else []
        cloud = cloud if len(cloud.points) else None
    origin = origin_of(np.stack([frame.eye for frame in frames]))
    if not origin.any():
        return PlacedCapture(tuple(frames), cloud, origin, tuple(notes))
    x, y, z = origin.tolist()
    notes.append(MovedOrigin((x, y, z)))
    moved = tuple(replace(frame, eye=frame.eye - origin) for frame in frames)
    cloud = None if cloud is None else replace(cloud, points=cloud.points - origin)
    return PlacedCapture(moved, cloud, origin, tuple(notes))

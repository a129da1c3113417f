"""A capture ready for training: views with cameras and photos, split, and an initial point cloud."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.validation import ArrayLike, one_of
from gsplat_edu.data.capture import Capture, Cloud, Frame, UnfitPhotoError, photo_file, whole_panoramas
from gsplat_edu.data.images import ImageStore, PhotoFile
from gsplat_edu.data.left_out import LEFT_OUT, is_left_out, read_left_out
from gsplat_edu.data.lens import CROPPED_ANGLE, MAX_ANGLE
from gsplat_edu.data.loading_notes import (
    CroppedPhotos,
    DistortedPhotos,
    IgnoredShutters,
    LoadingNote,
    MotionBlurs,
    NativeLenses,
    OnlyOnePhoto,
    PanoramaFaces,
    PhotosExceedMemory,
    RandomStart,
    RescaledIntrinsics,
    RollingShutters,
    SharedCentres,
    TurnedPhotos,
    UnevenFocalLengths,
    UnlistedPhotos,
)
from gsplat_edu.data.notes import Background, LeftOutPhotos, OnlyInRegion, UnreadColors, UnusablePhotos
from gsplat_edu.data.orientation import oriented
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.data.points import random_cloud
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.region import read_region
from gsplat_edu.data.region_masks import views_of_region
from gsplat_edu.data.scale import Scale
from gsplat_edu.data.settings import DataSettings as DataSettings
from gsplat_edu.data.visible_cloud import cloud_in_cube, cloud_in_view
from gsplat_edu.photos.decoding import UPRIGHT, PhotoHeaders
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.region import Region
from gsplat_edu.scene.rig import scene_extent as scene_extent, settled_eyes, stray_eyes
from gsplat_edu.scene.shutter import AT_ONCE
from gsplat_edu.scene.views import View

if TYPE_CHECKING:
    from gsplat_edu.data.torch_dataset import ViewDataset

TEST_EVERY = 8
"""Hold out every 8th view if the capture defines no split (the usual convention)."""

ONE_PLACE = 1e-5
"""Largest distance of two centres that count as one, as a fraction of the cameras' spread."""


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """A capture, ready for training.

    Args:
        path: The loaded path.
        layout: "COLMAP", "transforms.json", "Blender", or the name of another program or a plug-in.
        train: Training views, sorted by name; at least one.
        test: Test views, sorted by name.
        points: (N, 3) initial point cloud, in the cameras' coordinate frame, world units.
        colors: (N, 3) their colours, 0 to 1.
        origin: (3,) offset that was subtracted from all coordinates; zero unless they exceeded 1e4.
        notes: What was skipped, rescaled, undistorted or generated; `str` of a note gives the sentence for the user.
        images: The photo cache.
        files: Name and files of each photo, sorted by name.
        scale: What a unit of the coordinates is; None if unknown.
        measured: Whether the points come from a capture or a file; otherwise they are random.
        region: The box that the pixels show which count, in the cameras' coordinates; None if all count.
    """

    path: Path
    layout: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: Float64[np.ndarray, "N 3"]
    colors: Float64[np.ndarray, "N 3"]
    origin: Float64[np.ndarray, "3"]
    notes: tuple[LoadingNote, ...]
    images: ImageStore
    files: tuple[tuple[str, PhotoFile], ...] = ()
    scale: Scale | None = None
    measured: bool = True
    region: Region | None = None

    @classmethod
    def of(
        cls,
        reader: CaptureReader,
        settings: DataSettings = DataSettings(),  # noqa: B008 - it is frozen
        *,
        points: Path | None = None,
    ) -> Dataset:
        """Derive a dataset from a capture, without reading anything twice.

        Args:
            reader: The capture.
            settings: Resolution, split, background and memory.
            points: A file of points that replaces the capture's, in its coordinates; see `gsplat_edu.data.point_files`.

        Raises:
            DatasetError: the path holds no capture, or it cannot be used; names the file and what to do.
        """
        reader = reader.under(settings.reading)
        path, capture, headers, placed = reader.path, reader.capture, reader.headers, reader.placed(points)
        settings = with_own_files(settings, path)
        notes = list(placed.notes)
        placed_frames = placed.frames if settings.lens == "undistort" else whole_panoramas(placed.frames)
        listed = _listed(path, placed_frames, settings)
        about: list[LoadingNote] = []  # the choice of photos
        chosen, parts = _used(path, listed, _split(path, listed, settings, about), settings, about)
        frames, parts, made = _fitting(path, oriented(chosen, headers), parts, settings, headers, notes)
        sources = [source for source, *_ in made]
        decoding = max(headers.of(source.path).decoding for source in sources)
        store = ImageStore(settings.image_memory, sources, decoding, reader.watch)
        views = [
            View.stored(camera, partial(store.read, source), frame.name)
            for frame, (source, camera, _) in zip(frames, made, strict=True)
        ]
        region = Region.of_numbers(settings.region).moved(-placed.origin) if settings.region else None
        if region is not None:
            views, notes = list(views_of_region(views, region)), [*notes, OnlyInRegion()]
        notes += _notes_of_photos(capture, frames, made, settings, headers)
        if store.needed > store.budget:
            notes.append(PhotosExceedMemory(store.needed, store.budget))
        notes += about
        train, test = (
            tuple(v for v, p in zip(views, parts, strict=True) if p == part) for part in ("train", "test")
        )
        start = placed.cloud or _random_start(capture, [view.camera for view in train], notes, placed.origin)
        return cls(
            path,
            capture.layout,
            train,
            test,
            start.points,
            start.colors,
            placed.origin,
            tuple(notes),
            store,
            tuple((frame.name, source) for frame, source in zip(frames, sources, strict=True)),
            capture.scale,
            placed.cloud is not None,
            region,
        )

    def __repr__(self) -> str:
        """Return one line: layout, path, and numbers of views and points."""
        views = f"{len(self.train)} training and {len(self.test)} test views"
        return f"Dataset({self.layout}, {str(self.path)!r}, {views}, {len(self.points):,} points)"

    def torch(
        self,
        split: str = "train",
        *,
        crop: tuple[int, int] | None = None,
        corner: tuple[int, int] | None = None,
        background: ArrayLike = (0.0, 0.0, 0.0),
        seed: int = 0,
    ) -> ViewDataset:
        """Return the views of a part as a torch Dataset: images as float tensors, with their cameras.

        Args:
            split: "train" or "test".
            crop: (height, width) of the crops, px; None for whole photos.
            corner: (row, column) of the first pixel of every crop; None draws one at random for each view and epoch.
            background: (3,) colour behind transparent photos, 0 to 1.
            seed: Seed of the random corners; `ViewDataset.set_epoch` draws others.

        Raises:
            ArgumentError: the split has another name, a number is out of range, a photo is smaller than the crop, or a
                camera cannot be cropped.
            ShapeError: crop, corner or background has another number of entries.
        """
        from gsplat_edu.data.torch_dataset import ViewDataset  # it imports torch

        one_of("split", split, ("train", "test"))
        views = self.train if split == "train" else self.test
        return ViewDataset(views, crop=crop, corner=corner, background=background, seed=seed)

    def preload(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Decode every photo once, several in parallel, and keep those within the budget.

        Args:
            progress: Called after each photo with the number done and the total, in the calling thread.

        Raises:
            DatasetError: a photo cannot be decoded; names the first one by name.
        """
        views = (*self.train, *self.test)

        def decode(view: View) -> None:
            view.read()  # not returned: the futures would keep photos beyond the budget

        with ThreadPoolExecutor(self.images.workers) as pool:
            futures = [pool.submit(decode, view) for view in views]
            try:
                for done, future in enumerate(futures, 1):
                    future.result()
                    if progress is not None:
                        progress(done, len(views))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def load_dataset(
    path: str | Path,
    settings: DataSettings = DataSettings(),  # noqa: B008 - it is frozen
    *,
    points: Path | None = None,
) -> Dataset:
    """Load a capture. Only the photos' headers are read; pixels are decoded when needed.

    For several datasets of one capture, make a `gsplat_edu.data.reader.CaptureReader` and call `Dataset.of`.

    Args:
        path: A capture folder of COLMAP, nerfstudio, instant-ngp or Blender; or a transforms.json.
        settings: Resolution, split, background and memory.
        points: A file of points that replaces the capture's, in its coordinates; see `gsplat_edu.data.point_files`.

    Raises:
        DatasetError: the path holds no capture, or it cannot be used; names the file and what to do.
    """
    return Dataset.of(CaptureReader(path), settings, points=points)


def _notes_of_photos(
    capture: Capture,
    frames: Sequence[Frame],
    made: Sequence[tuple[PhotoFile, Camera, bool]],
    settings: DataSettings,
    headers: PhotoHeaders,
) -> list[LoadingNote]:
    """Return the notes about lenses, shutters, files and alpha of the photos that are used."""
    sources = [source for source, *_ in made]
    return [
        *_lens_notes(frames, sources, [rescaled for _, _, rescaled in made]),
        *_shutter_notes(frames, [camera for _, camera, _ in made], settings),
        *_file_notes(frames, sources, headers),
        *_alpha_notes(capture, sources, settings, headers),
    ]


def with_own_files(settings: DataSettings, path: Path) -> DataSettings:
    """Return settings with what the capture's own files say: the photos that it leaves out, and its region.

    Args:
        settings: What they give counts instead.
        path: The capture.

    Raises:
        DatasetError: a file is damaged or cannot be read.
    """
    if settings.left_out is None and settings.train_views is None:
        settings = replace(settings, left_out=read_left_out(path))
    if settings.region is None:
        region = read_region(path)
        settings = replace(settings, region=() if region is None else region.numbers)
    return settings


def _listed(path: Path, frames: Sequence[Frame], settings: DataSettings) -> Sequence[Frame]:
    """Return the frames that the settings name, or all if they name none."""
    if settings.train_views is None:
        return frames
    names = (*settings.train_views, *settings.test_views)
    by_name = {frame.name: frame for frame in frames}
    if missing := [name for name in names if name not in by_name]:
        raise DatasetError(
            f"{path}: {len(missing)} of the {len(names)} photos asked for are missing here, first {missing[0]};"
            " copy them here, or mount the folder that has them"
        )
    return [by_name[name] for name in sorted(set(names))]


def _lens_notes(
    frames: Sequence[Frame], sources: Sequence[PhotoFile], rescaled: Sequence[bool]
) -> list[LoadingNote]:
    """Report changes of the intrinsics, and photos that keep their lens."""
    resampled = [frame for frame, source in zip(frames, sources, strict=True) if source.resampled]
    faces = [frame for frame in resampled if isinstance(frame.lens, FaceLens)]
    notes: list[LoadingNote] = [PanoramaFaces(len(faces), len(frames))] if faces else []
    if kept := sum(source.native for source in sources):
        notes.append(NativeLenses(kept, len(frames)))
    distorted = [frame for frame in resampled if not isinstance(frame.lens, FaceLens)]
    if distorted:
        notes.append(DistortedPhotos(len(distorted), len(frames)))
    if wide := [frame.name for frame in distorted if frame.lens.cropped]:
        seen, shown = (round(2 * math.degrees(angle)) for angle in (MAX_ANGLE, CROPPED_ANGLE))
        notes.append(CroppedPhotos(len(wide), len(frames), wide[0], seen, shown))
    if others := [frame for frame, is_it in zip(frames, rescaled, strict=True) if is_it]:
        notes.append(RescaledIntrinsics(len(others), len(frames), others[0].name))
    uneven = [frame for frame in frames if frame.lens.uneven and not isinstance(frame.lens, FaceLens)]
    if uneven:
        lens = uneven[0].lens
        notes.append(UnevenFocalLengths(len(uneven), len(frames), lens.fx, lens.fy))
    return notes


def _shutter_notes(
    frames: Sequence[Frame], cameras: Sequence[Camera], settings: DataSettings
) -> list[LoadingNote]:
    """Report rolling shutters, and those that are ignored."""
    notes: list[LoadingNote] = []
    moved = [camera.shutter for camera in cameras if camera.shutter is not None]
    rolling = [shutter for shutter in moved if shutter.readout != AT_ONCE]
    if turns := [float(np.linalg.norm(shutter.turn)) for shutter in rolling]:
        notes.append(RollingShutters(len(turns), len(frames), math.degrees(float(np.median(turns)))))
    if blurred := sum(shutter.exposure > 0 for shutter in moved):
        notes.append(MotionBlurs(blurred, len(frames)))
    moving = zip(frames, cameras, strict=True)
    ignored = [frame for frame, camera in moving if frame.shutter is not None and camera.shutter is None]
    if ignored:
        notes.append(
            IgnoredShutters(len(ignored), len(frames), ignored[0].name, settings.lens == "undistort")
        )
    return notes


def _alpha_notes(
    capture: Capture,
    sources: Sequence[PhotoFile],
    settings: DataSettings,
    headers: PhotoHeaders,
) -> list[LoadingNote]:
    """Report the background of transparent photos."""
    count = sum(headers.of(source.path).alpha for source in sources)
    if not count:
        return []
    return [Background(count, len(sources), settings.background, capture.layout == "Blender")]


def _file_notes(
    frames: Sequence[Frame], sources: Sequence[PhotoFile], headers: PhotoHeaders
) -> list[LoadingNote]:
    """Report colours that are not converted, and photos that are turned."""
    problems = [
        (frame.name, headers.of(source.path).problem) for frame, source in zip(frames, sources, strict=True)
    ]
    notes: list[LoadingNote] = [*UnreadColors.of(problems)]
    turned = [
        frame.name for frame, source in zip(frames, sources, strict=True) if source.orientation != UPRIGHT
    ]
    if turned:
        notes.append(TurnedPhotos(len(turned), len(frames), turned[0]))
    return notes


def _split(
    path: Path, frames: Sequence[Frame], settings: DataSettings, notes: list[LoadingNote]
) -> list[str]:
    """Divide frames, sorted by name, into training and test views: return the part of each.

    Parts are "train", "test", and "left out" of frames that the capture's lists do not name.
    """
    test_every, count = settings.test_every, len(frames)
    if settings.train_views is not None:
        held_out = frozenset(settings.test_views)
        parts = ["test" if frame.name in held_out else "train" for frame in frames]
    elif test_every is None and any(frame.part for frame in frames):
        parts = [frame.part for frame in frames]
        if unlisted := count - sum(part in ("train", "test") for part in parts):
            notes.append(UnlistedPhotos(unlisted, count))
    elif test_every == 0 or (test_every is None and count == 1):
        parts = ["train"] * count
        if test_every is None:
            notes.append(OnlyOnePhoto())
    else:
        every, places = test_every or TEST_EVERY, _places([frame.eye for frame in frames])
        if max(places) == 0:  # all views have one centre: the capture is one panorama
            places = list(range(count))
        elif (centres := max(places) + 1) < count:
            notes.append(SharedCentres(count, centres))
        parts = ["train" if place % every else "test" for place in places]
    if "train" not in parts:
        raise DatasetError(
            f"{path}: the split leaves none of its {count} photos for training; set test_every to 0"
        )
    return parts


def _used(
    path: Path,
    frames: Sequence[Frame],
    parts: Sequence[str],
    settings: DataSettings,
    notes: list[LoadingNote],
) -> tuple[list[Frame], list[str]]:
    """Return the frames that are not left out, with their parts, and report the others."""
    if settings.train_views is not None:
        return list(frames), list(parts)
    out = [is_left_out(frame, path, settings.left_out or ()) for frame in frames]
    if any(out):
        notes.append(LeftOutPhotos(sum(out), len(frames), frames[out.index(True)].name))
    kept = [part for part, gone in zip(parts, out, strict=True) if not gone]
    if "train" not in kept:
        raise DatasetError(
            f"{path}: {LEFT_OUT} leaves out every photo for training; take some off it, or set test_every to 0"
        )
    return [frame for frame, gone in zip(frames, out, strict=True) if not gone], kept


def _fitting(
    path: Path,
    frames: Sequence[Frame],
    parts: Sequence[str],
    settings: DataSettings,
    headers: PhotoHeaders,
    notes: list[LoadingNote],
) -> tuple[list[Frame], list[str], list[tuple[PhotoFile, Camera, bool]]]:
    """Return the frames whose photos fit their cameras, with their parts and files, and report the others."""
    fitting, problems, error = list[tuple[Frame, str, tuple[PhotoFile, Camera, bool]]](), [], None
    for frame, part in zip(frames, parts, strict=True):
        try:
            fitting.append((frame, part, photo_file(frame, settings, headers)))
        except UnfitPhotoError as unfit:
            problems.append((frame.name, unfit.reason))
            error = error or unfit
    if error is not None:
        if not fitting:
            raise error
        if not any(part == "train" for _, part, _ in fitting):
            raise DatasetError(f"{path}: no photo for training fits its camera, first {error}")
        earlier = next((note for note in notes if isinstance(note, UnusablePhotos)), None)
        if earlier is None:
            notes.append(UnusablePhotos(tuple(problems), len(frames)))
        else:
            both = (*earlier.problems, *problems)
            notes[notes.index(earlier)] = UnusablePhotos(both, earlier.total)
    kept, parts_kept, made = [list(column) for column in zip(*fitting, strict=True)]
    return kept, parts_kept, made


def _places(centres: Sequence[Float64[np.ndarray, "3"]]) -> list[int]:
    """Number the centres of cameras in the order in which they occur; centres within `ONE_PLACE` are one.

    Only the centres of a panorama's faces agree so well; poses estimated photo by photo never do.
    """
    eyes = np.stack(centres)
    settled = eyes[~stray_eyes(eyes)]
    near = ONE_PLACE * float(np.linalg.norm(settled - settled.mean(axis=0), axis=1).max())
    tree, number = cKDTree(eyes), list[int]()
    found = dict[int, int]()
    for i, others in enumerate(tree.query_ball_point(eyes, near)):
        first = min(others)
        number.append(found.setdefault(first, len(found)) if first == i else number[first])
    return number


def _random_start(
    capture: Capture, cameras: Sequence[Camera], notes: list[LoadingNote], origin: Float64[np.ndarray, "3"]
) -> Cloud:
    """Generate random initial points where the training photos look, and report it."""
    half_edge = capture.cube
    made = cloud_in_view(cameras) if half_edge is None else cloud_in_cube(cameras, -origin, half_edge)
    shared = made is not None
    if made is None:
        half_edge = scene_extent(cameras)
        made = random_cloud(settled_eyes(cameras).mean(axis=0), half_edge)
    notes.append(RandomStart(capture.no_cloud, len(made.points), half_edge, shared))
    return made

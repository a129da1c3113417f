"""The survey of a capture: read its poses, measure every photo once, and collect unusable photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import PHOTO_ENDINGS, Capture, Frame, entries, is_folder, photo_file
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.depths import DepthReport, DepthSource, judged_depths
from gsplat_edu.data.left_out import LEFT_OUT, is_left_out, read_left_out, without_pose
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.notes import LeftOutPhotos, Note, UnreadColors
from gsplat_edu.data.orientation import oriented
from gsplat_edu.data.points import finite_cloud
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.photos.decoding import PhotoHeaders, recorded_exposure
from gsplat_edu.scene.camera import Camera
from gsplat_edu.survey.geometry import Geometry
from gsplat_edu.survey.photos import PhotoStats, measure_photo, unmeasured
from gsplat_edu.survey.proof import Proof, prove
from gsplat_edu.survey.support import observed_points

WORKERS = 2
"""Photos decoded at the same time: a JPEG briefly takes up to 40 MB, other formats their full size."""

Progress = Callable[[int, int], None]
"""Called with (photos done, total)."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A readable photo with its camera.

    Args:
        name: Its name in the capture.
        lens: Its camera as given by the capture.
        size: Width and height of the file, px.
        camera: The undistorted pinhole camera at the thumbnail's size.
        stats: Its thumbnail and measurements.
        colors: Why its colours are taken as sRGB although its file declares another space; empty if they are converted.
        exposure: Brightness by its EXIF (`gsplat_edu.photos.decoding.recorded_exposure`), stops; None if it has none.
    """

    name: str
    lens: Lens
    size: tuple[int, int]
    camera: Camera
    stats: PhotoStats
    colors: str = ""
    exposure: float | None = None


class Refused(NamedTuple):
    """A photo that cannot be used."""

    name: str
    """Its name in the capture."""
    reason: str
    """The reason in a few words: `DatasetError.reason`."""


@dataclass(frozen=True, eq=False)
class Survey:
    """Input of the checks.

    Args:
        path: The capture.
        layout: "COLMAP", "transforms.json", "Blender", or the name of another program or a plug-in.
        shots: Readable photos, sorted by name.
        refused: Unusable photos, sorted by name.
        unposed: Names of photos that have no pose: those in the same folders, and those that the search left out.
        points: (N, 3) the capture's own points, world units; N is 0 if it has none.
        notes: Notes of the capture's reader.
        observed: Number of points observed in each photo, by shot name; empty if unknown.
        depth: What was found about depth that the user has, or why it cannot be used; None if it was not read.
        proof: What the photos say about the poses; None if they were not compared.
    """

    path: Path
    layout: str
    shots: tuple[Shot, ...]
    refused: tuple[Refused, ...]
    unposed: tuple[str, ...]
    points: Float64[np.ndarray, "N 3"]
    notes: tuple[Note, ...]
    observed: Mapping[str, int] = field(default_factory=dict)
    depth: DepthReport | DatasetError | None = None
    proof: Proof | None = None

    @property
    def reading(self) -> str | None:
        """The reading of the poses that the photos show to be right; None for that of the capture's format."""
        return (self.proof and self.proof.reading) or None

    @property
    def names(self) -> list[str]:
        """Names of the readable photos."""
        return [shot.name for shot in self.shots]

    @cached_property
    def geometry(self) -> Geometry:
        """Geometry of the cameras; needs at least one shot."""
        return Geometry([shot.camera for shot in self.shots], self.points)


def prepare(
    reader: CaptureReader,
    progress: Progress | None = None,
    sharpness: bool = True,
    depth: Path | None = None,
    left_out: Sequence[str] | None = None,
    trust: bool = False,
) -> Survey:
    """Read a capture and measure its photos, a few at a time; poses that were misread are read as the photos show.

    Args:
        reader: The capture.
        progress: Called with (photos done, total) in the calling thread.
        sharpness: Measure the photos' sharpness and compare them with the poses too, which takes most of the time.
        trust: Do not compare them with the poses.
        depth: Where depth comes from that is judged too; see `gsplat_edu.data.depths.DepthSource`.
        left_out: Photos that are not used; None uses the capture's own list.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read. Unreadable photos raise no error.
    """
    proof = prove(reader, left_out) if sharpness and not trust else None
    if proof is not None:
        reader = reader.under(proof.reading or None)
    frames, left = _used(reader, left_out)
    headers = reader.headers
    shots, refused = list[Shot](), list[Refused]()
    with ThreadPoolExecutor(WORKERS) as pool:
        try:
            for done, found in enumerate(pool.map(partial(_shot, headers, sharpness), frames), 1):
                if isinstance(found, Shot):
                    shots.append(found)
                else:
                    refused.append(found)
                if progress is not None:
                    progress(done, len(frames))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    judged: DepthReport | DatasetError | None = None
    if depth is not None and shots:
        judged = _judged_depth(reader, [(shot.name, shot.camera) for shot in shots], depth)
    survey = _survey(reader, shots, refused, left, judged)
    return replace(survey, proof=proof) if len(shots) > 1 else survey


class Undecided:
    """The capture of a run that leaves settings open. What a choice needs is read when it is first asked for.

    Args:
        reader: The capture.
        settings: How the run reads it.
        points: The run's file of start points; None if it has none.
        progress: Called with (photos done, total) while photos are read.
    """

    def __init__(
        self,
        reader: CaptureReader,
        settings: DataSettings,
        points: Path | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._reader, self._settings, self._points, self._progress = reader, settings, points, progress

    @cached_property
    def survey(self) -> Survey:
        """The capture with its photos, whose sharpness is not measured.

        Raises:
            DatasetError: the capture or its poses cannot be read. Unreadable photos raise no error.
        """
        return prepare(self._reader, self._progress, sharpness=False, left_out=self._settings.left_out)

    @cached_property
    def training_photos(self) -> int:
        """Number of the training's photos.

        Raises:
            DatasetError: the capture cannot be read.
        """
        return len(Dataset.of(self._reader, self._settings, points=self._points).train)


def survey_of_poses(reader: CaptureReader, left_out: Sequence[str] | None = None) -> Survey:
    """Read a capture for the checks that need no pixels: only the photos' headers are read.

    Args:
        reader: The capture.
        left_out: Photos that are not used; None uses the capture's own list.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read. Unreadable photos raise no error.
    """
    frames, left = _used(reader, left_out)
    shots, refused = list[Shot](), list[Refused]()
    for frame in frames:
        try:
            _, camera, _ = photo_file(frame, DataSettings(), reader.headers)
        except DatasetError as error:
            refused.append(Refused(frame.name, error.reason))
        else:
            shots.append(Shot(frame.name, frame.lens, (camera.W, camera.H), camera, unmeasured()))
    return _survey(reader, shots, refused, left)


def _used(
    reader: CaptureReader, left_out: Sequence[str] | None
) -> tuple[Sequence[Frame], Sequence[LeftOutPhotos]]:
    """Return the frames that are used, sorted by name and turned upright, and a note about the others."""
    capture = reader.capture
    listed = read_left_out(reader.path) if left_out is None else left_out
    used = [frame for frame in capture.frames if not is_left_out(frame, reader.path, listed)]
    if not used:
        raise DatasetError(f"{reader.path}: {LEFT_OUT} leaves out every photo; take some off it")
    gone = sorted({frame.name for frame in capture.frames} - {frame.name for frame in used})
    left = [LeftOutPhotos(len(gone), len(capture.frames), gone[0])] if gone else []
    return oriented(sorted(used, key=lambda frame: frame.name), reader.headers), left


def _survey(
    reader: CaptureReader,
    shots: Sequence[Shot],
    refused: Sequence[Refused],
    left: Sequence[LeftOutPhotos],
    judged: DepthReport | DatasetError | None = None,
) -> Survey:
    """Add to the photos of a survey what the capture has besides."""
    capture = reader.capture
    return Survey(
        reader.path,
        capture.layout,
        tuple(shots),
        tuple(refused),
        tuple(dict.fromkeys((*_unposed(capture), *without_pose(reader.path)))),
        _points(capture),
        (*capture.notes, *left, *UnreadColors.of([(shot.name, shot.colors) for shot in shots])),
        observed_points(reader.path) if capture.layout == "COLMAP" else {},
        judged,
    )


def _shot(headers: PhotoHeaders, sharpness: bool, frame: Frame) -> Shot | Refused:
    """Measure a photo, or return the reason why it cannot be used."""
    try:
        source, camera, _ = photo_file(frame, DataSettings(), headers)
        colors = headers.of(source.path).problem
        stats = measure_photo(source, sharpness)
    except DatasetError as error:
        return Refused(frame.name, error.reason)
    h, w = stats.thumbnail.shape[:2]
    small = camera.scaled(w, h)
    exposure = recorded_exposure(source.path)
    return Shot(frame.name, frame.lens, (camera.W, camera.H), small, stats, colors, exposure)


def _judged_depth(
    reader: CaptureReader, cameras: Sequence[tuple[str, Camera]], path: Path
) -> DepthReport | DatasetError:
    """Read all depth of a capture; return what was found, or why nothing can be used."""
    try:
        return judged_depths(reader, cameras, DepthSource(path)).report
    except DatasetError as error:
        return error


def _points(capture: Capture) -> Float64[np.ndarray, "N 3"]:
    if capture.cloud is None:
        return np.zeros((0, 3))
    return finite_cloud(capture.cloud)[0].points


def _unposed(capture: Capture) -> tuple[str, ...]:
    """List the photos without a pose in the folders of the posed ones.

    Blender captures are skipped: every photo has a pose, and depth maps lie beside the photos.
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

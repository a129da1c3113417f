"""The depth that a user has for the photos of a capture: files of maps, or the points of COLMAP's tracks.

Everything is judged before a training: `judged_depths` reads each map once, finds unit and kind from the points that
the photos see, and says what is missing or rejected. A view reads its map again when a step needs it.

The map of a photo that keeps its lens is read in the lens's own pixels, without resampling. Its depth is that of the
lens's projection: z, or the distance from the camera for a fisheye or a panorama (`Projection.along_ray`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import short_number
from gsplat_edu.data.capture import Frame, file_name, fits_camera, is_folder, whole_panoramas
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.depth_fit import (
    AUTO_KIND,
    INVERSE,
    RAY,
    DepthFit,
    Matches,
    PhotoFit,
    Rejected,
    Z,
    fit_depths,
    matched,
    no_jumps,
)
from gsplat_edu.data.depth_folder import GEOMETRIC_MAPS, DepthFile, confidence_of, depth_files, read_map
from gsplat_edu.data.lens import Lens, bands, undistortion
from gsplat_edu.data.native_lens import native_intrinsics
from gsplat_edu.data.orientation import oriented
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.sparse_depth import sparse_depth, tracked_points
from gsplat_edu.data.tracks import visible_points
from gsplat_edu.photos.decoding import turned, upright_size
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.given_depth import CAPTURE_AS_DEPTH, POINTS_AS_DEPTH, SCAN_AS_DEPTH, GivenDepth
from gsplat_edu.scene.intrinsics import Intrinsics

POINTS, CAPTURE, SCAN = Path(POINTS_AS_DEPTH), Path(CAPTURE_AS_DEPTH), Path(SCAN_AS_DEPTH)
"""Sources of depth that are no folders: the points in COLMAP's tracks, the maps that transforms.json names, and the
file of a scanner's points."""

JUMP = 0.05
"""Pixels beside a jump of more than this fraction of the inverse depth are left out."""

MOST_SAMPLES = 2**16
"""Most samples of a photo: 1.3 times the pixels of a phone's sensor. Of larger maps every n-th column and row count."""

FEW_POINTS = 20
"""Points of a photo below which its tracks say little."""

LEAST_COSINE = 0.1
"""Smallest cosine of the angle to the optical axis at which z tells the distance: nearer to 90 degrees, a small error
of z is a large one of the distance."""

FEW_PIXELS = 33
"""Width and height at which a lens is examined for rays that look behind."""

READABLE_MAPS = 3
"""Reasons that are named in a sentence about rejected maps."""


@dataclass(frozen=True)
class DepthSource:
    """Where depth comes from, and what the values of maps are.

    Args:
        path: `POINTS`, `CAPTURE`, or the folder of maps.
        kind: One of `gsplat_edu.data.depth_fit.KINDS`.
        unit: World units for a unit of the maps; 0 to find it from the points.
    """

    path: Path
    kind: str = AUTO_KIND
    unit: float = 0.0


def own_depth(reader: CaptureReader) -> Path | None:
    """Return the source of the depth maps that a capture brings along; None if it has none."""
    named = any(frame.depth is not None for frame in reader.capture.frames)
    return CAPTURE if named or is_folder(reader.path / GEOMETRIC_MAPS) else None


@dataclass(frozen=True)
class DepthReport:
    """What was found about the depth of a capture.

    Args:
        source: Where it comes from.
        photos: Number of photos.
        used: Number of photos with depth that is used.
        missing: Photos without a map, or with few points.
        fit: How maps become depth; None for points.
        points: Median number of points of a photo, for `POINTS` and `SCAN`.
    """

    source: Path
    photos: int
    used: int
    missing: tuple[str, ...]
    fit: DepthFit | None = None
    points: int = 0

    @property
    def rejected(self) -> tuple[Rejected, ...]:
        """Photos whose maps disagree with the points."""
        return () if self.fit is None else self.fit.rejected

    def lines(self) -> list[str]:
        """Return a sentence for each fact."""
        if self.fit is None:
            what = "from the scan" if self.source == SCAN else "from the points in their tracks"
            first = f"depth of {self.used} of {self.photos} photos {what}, {self.points} points in a photo"
            few = f"{len(self.missing)} photos see fewer than {FEW_POINTS} points: {matched(self.missing)}"
            return [first, *([few] if self.missing else [])]
        said = [f"depth maps of {self.used} of {self.photos} photos: {_kind_text(self.fit)}"]
        if self.missing:
            said.append(f"{len(self.missing)} photos have no depth map: {matched(self.missing)}")
        if self.rejected:
            first = "; ".join(f"{name} ({reason})" for name, reason in self.rejected[:READABLE_MAPS])
            said.append(
                f"{len(self.rejected)} depth maps are not used, because they disagree with the points: {first}"
            )
        return said


def _kind_text(fit: DepthFit) -> str:
    agree = f"they agree with {fit.points:,} points to {100 * fit.spread:.1f} %"
    if fit.kind == INVERSE:
        return f"inverse depth, with a scale and a shift for each photo; {agree}"
    what = "ray length" if fit.kind == RAY else "z"
    unit = f"{what} in a unit of {short_number(fit.unit, 4)} world units"
    if not fit.points:
        return f"{unit}, unchecked: no points lie where the maps have depth"
    other = "z" if fit.kind == RAY else "ray length"
    sure = "" if fit.certain else f" (or {other}: the photos are too narrow to tell)"
    return f"{unit}{sure}; {agree}"


@dataclass(frozen=True, eq=False)
class Depths:
    """Depth that was judged.

    Args:
        views: By photo, a function that returns its depth; photos without usable depth are missing.
        report: What was found.
    """

    views: Mapping[str, Callable[[], GivenDepth]]
    report: DepthReport


def depth_name(path: Path) -> str:
    """Return how config.json names the source of depth: the folder's full path, or the word."""
    return str(path if path in (POINTS, CAPTURE, SCAN) else path.resolve())


def with_depth(
    dataset: Dataset, reader: CaptureReader, source: DepthSource, points: Path | None = None
) -> tuple[Dataset, DepthReport]:
    """Give the training views of a dataset their depth.

    Args:
        dataset: The dataset, derived from `reader` with the same `points`.
        reader: The capture.
        source: Where depth comes from.
        points: A file that replaces the capture's points.

    Raises:
        DatasetError: as for `judged_depths`.
    """
    depths = judged_depths(reader, [(view.name, view.camera) for view in dataset.train], source, points)
    train = tuple(view.with_depth(depths.views.get(view.name)) for view in dataset.train)
    return replace(dataset, train=train), depths.report


def judged_depths(
    reader: CaptureReader,
    cameras: Sequence[tuple[str, Camera]],
    source: DepthSource,
    points: Path | None = None,
) -> Depths:
    """Read the depth of photos, and compare maps with the points that the photos see.

    Args:
        reader: The capture.
        cameras: Name and camera of each photo, as a dataset of the capture has them.
        source: Where depth comes from.
        points: A file that replaces the capture's points.

    Raises:
        DatasetError: there is no depth, a file is damaged or has another shape than its photo, maps agree with the
            points in no unit, or they are of panoramas that are cut into faces.
    """
    if source.path == SCAN:
        return _of_scan(reader, cameras, points)
    seen = _seen(reader, cameras, points, source.path == POINTS)
    if source.path == POINTS:
        return _of_points(reader.path, cameras, seen)
    kept = {name for name, camera in cameras if not camera.projection.plain}
    faces = reader.placed(points).frames
    frames = {frame.name: frame for frame in oriented([*faces, *whole_panoramas(faces)], reader.headers)}
    chosen = [frames[name] for name, _ in cameras]
    cut = (frame.name for frame in chosen if isinstance(frame.lens, FaceLens) and frame.name not in kept)
    if face := next(cut, None):
        raise DatasetError(
            f"{reader.path}: {face} is one of a panorama's faces, which have no depth maps; train with `lens=native`,"
            " which keeps panoramas whole"
        )
    files = _files(reader.path, chosen, source.path)
    placed = {name: _Placed(file, frames[name], name in kept) for name, file in files.items()}
    matches = {name: each.matches(seen.get(name), source.kind) for name, each in placed.items()}
    where = str(reader.path if source.path == CAPTURE else source.path)
    usual = RAY if any(map(_sees_behind, {camera.intrinsics for _, camera in cameras})) else Z
    fit = fit_depths(matches, source.kind, source.unit, where, usual)
    views = {name: partial(placed[name].samples, fit.kind, found) for name, found in fit.photos.items()}
    missing = tuple(name for name, _ in cameras if name not in files)
    return Depths(views, DepthReport(source.path, len(cameras), len(views), missing, fit))


def _files(capture: Path, frames: Sequence[Frame], folder: Path) -> dict[str, DepthFile]:
    """Return the maps by photo: of a folder, or those that the capture names."""
    if folder != CAPTURE:
        return depth_files(folder, [frame.name for frame in frames])
    named = {frame.name: frame.depth for frame in frames if frame.depth is not None}
    if not named and not is_folder(capture / GEOMETRIC_MAPS):
        raise DatasetError(
            f"{capture}: holds no depth map: transforms.json names none as depth_file_path, and there is no folder"
            f" {GEOMETRIC_MAPS}; give `depth` the folder of maps"
        )
    if not named:
        return depth_files(capture / GEOMETRIC_MAPS, [frame.name for frame in frames])
    return {name: DepthFile(path, confidence_of(path)) for name, path in named.items()}


def _seen(
    reader: CaptureReader, cameras: Sequence[tuple[str, Camera]], points: Path | None, tracks_only: bool
) -> dict[str, GivenDepth]:
    """Return the points that photos see: by the tracks, or else those of the cloud that nothing hides."""
    placed = reader.placed(points)
    tracked = tracked_points(reader.path) if reader.capture.layout == "COLMAP" else None
    if tracked is not None:
        near = tracked.points - placed.origin
        listed = {frame.name: file_name(frame) for frame in placed.frames}
        return {
            name: sparse_depth(camera, near[tracked.seen[listed.get(name, name)]])
            for name, camera in cameras
            if listed.get(name, name) in tracked.seen
        }
    if tracks_only or placed.cloud is None:
        return {}
    cloud = placed.cloud.points
    return {
        name: sparse_depth(camera, cloud[visible_points(camera, cloud).points]) for name, camera in cameras
    }


def _of_points(path: Path, cameras: Sequence[tuple[str, Camera]], seen: Mapping[str, GivenDepth]) -> Depths:
    used = {name: each for name, each in seen.items() if len(each)}
    if not used:
        raise DatasetError(
            f"{path}: has no tracks of points that photos see; `depth=points` needs a COLMAP model with points3D and"
            " the observations in images"
        )
    return _depths(POINTS, cameras, used)


def _of_scan(reader: CaptureReader, cameras: Sequence[tuple[str, Camera]], points: Path | None) -> Depths:
    cloud = None if points is None else reader.placed(points).cloud
    if cloud is None:
        raise DatasetError("depth: comes from the scan that `points` names; give `points=FILE`")
    seen = {
        name: sparse_depth(
            camera,
            cloud.points[visible_points(camera, cloud.points, MOST_SAMPLES).points],
            triangulated=False,
        )
        for name, camera in cameras
    }
    return _depths(SCAN, cameras, {name: each for name, each in seen.items() if len(each)})


def _depths(source: Path, cameras: Sequence[tuple[str, Camera]], used: Mapping[str, GivenDepth]) -> Depths:
    few = tuple(name for name, _ in cameras if name not in used or len(used[name]) < FEW_POINTS)
    middle = int(np.median([len(each) for each in used.values()] or [0]))
    views = {name: partial(_same, each) for name, each in used.items()}
    return Depths(views, DepthReport(source, len(cameras), len(used), few, points=middle))


def _same(depth: GivenDepth) -> GivenDepth:
    return depth


def _sees_behind(lens: Intrinsics) -> bool:
    """Return whether a lens has rays at 90 degrees or more to its axis, where there is no positive z."""
    if not lens.projection.along_ray:
        return False
    along = Camera.posed(np.eye(3), np.zeros(3), lens.scaled(FEW_PIXELS, FEW_PIXELS)).rays()[..., 2]
    return bool((along <= 0).any())  # NaN, of a pixel without a ray, is not


class _Placed:
    """A depth map and the camera that its photo has.

    Args:
        file: The map.
        frame: The photo.
        native: Whether the photo keeps its lens.
    """

    def __init__(self, file: DepthFile, frame: Frame, native: bool) -> None:
        self._file, self._frame, self._native = file, frame, native

    def _read(self) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"], Intrinsics]:
        """Return values and weights of the map and its lens; undistorted, with a pinhole, unless the lens is kept.

        Raises:
            DatasetError: the map has another aspect ratio than the photo.
        """
        values, weights = read_map(self._file)
        lens, turn = self._frame.lens, self._frame.orientation
        h, w = values.shape
        if not fits_camera(lens, (w, h)) and fits_camera(lens, upright_size((w, h), turn)):
            values, weights = turned(values, turn), turned(weights, turn)
            h, w = values.shape
        if not fits_camera(lens, (w, h)):
            raise DatasetError(
                f"{self._file.path}: is {w}x{h} px, but the camera of {self._frame.name} {lens.W}x{lens.H}, another"
                " aspect ratio; was one of the two cropped or turned?"
            )
        kept = native_intrinsics(lens) if self._native else None
        if kept is not None:
            return values.astype(np.float64), weights.astype(np.float64), kept.scaled(w, h)
        small = lens.scaled(w, h)
        if not lens.distorts:
            return values.astype(np.float64), weights.astype(np.float64), small.undistorted()
        return _undistorted(values, small, np.nan), _undistorted(weights, small, 0.0), small.undistorted()

    def matches(self, seen: GivenDepth | None, kind: str) -> Matches:
        """Return the values of the map where the photo sees points."""
        values, weights, lens = self._read()
        if seen is None:
            return Matches(np.zeros(0), np.zeros(0), np.zeros(0))
        h, w = values.shape
        rays, z = seen.rays.astype(np.float64), seen.depths.astype(np.float64)
        u = np.rint(lens.fx * rays[:, 0] + lens.cx).astype(np.int64)
        v = np.rint(lens.fy * rays[:, 1] + lens.cy).astype(np.int64)
        u = u % w if lens.projection.wraps else u
        held = (u >= 0) & (u < w) & (v >= 0) & (v < h)
        u, v, rays, z = u[held], v[held], rays[held], z[held]
        found = values[v, u]
        known = np.isfinite(found) & (weights[v, u] > 0)
        found, rays, z = found[known], rays[known], z[known]
        if lens.projection.plain:
            return Matches(found, z, np.sqrt(1 + (rays**2).sum(axis=1)))
        along, length = _ray_of_depth_1(lens, rays[:, 0], rays[:, 1])
        if kind == INVERSE:
            return Matches(found, z, np.ones_like(z))
        ahead = np.isfinite(along)
        return Matches(found[ahead], (z * along)[ahead], (length / along)[ahead])

    def samples(self, kind: str, fit: PhotoFit) -> GivenDepth:
        """Return the depth of the map's pixels."""
        values, weights, lens = self._read()
        h, w = values.shape
        x, y = np.meshgrid((np.arange(w) - lens.cx) / lens.fx, (np.arange(h) - lens.cy) / lens.fy)
        along, length = _ray_of_depth_1(lens, x, y)
        with np.errstate(divide="ignore", invalid="ignore"):
            if kind == INVERSE:
                inverse = fit.scale * values + fit.shift
                depth = np.where(inverse * fit.farthest > 1, 1 / inverse, np.nan)
            else:
                depth = fit.scale * values / (length if kind == RAY else along)
        step = int(np.ceil(np.sqrt(h * w / MOST_SAMPLES)))
        held = no_jumps(depth, JUMP, lens.projection.wraps) & (weights > 0) & np.isfinite(length)
        chosen = np.zeros_like(held)
        chosen[step // 2 :: step, step // 2 :: step] = True
        held &= chosen
        return GivenDepth(np.stack([x[held], y[held]], axis=1), depth[held], weights[held])


def _ray_of_depth_1(
    lens: Intrinsics, a: Float64[np.ndarray, "*n"], b: Float64[np.ndarray, "*n"]
) -> tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]]:
    """Return z and the length of the ray of depth 1 through each place (a, b) on the lens's plane.

    Both are NaN where there is no ray, z where it does not tell the distance (`LEAST_COSINE`).
    """
    if lens.projection.plain:
        return np.ones_like(a), np.sqrt(1 + a * a + b * b)
    camera = Camera.posed(np.eye(3), np.zeros(3), lens)
    rays = lens.projection.directions(a, b, camera.widest)
    along, length = rays[..., 2], np.sqrt((rays * rays).sum(axis=-1))
    tells = (along > LEAST_COSINE) if lens.projection.along_ray else np.isfinite(along)
    return np.where(tells, along, np.nan), length


def _undistorted(values: np.ndarray, lens: Lens, missing: float) -> Float64[np.ndarray, "h w"]:
    """Take each pixel of the pinhole image from the nearest pixel of the map; `missing` where it has none."""
    out = np.full((lens.H, lens.W), missing)
    for band in bands(lens.H):
        columns, rows, valid = undistortion(lens, band)
        u, v = (np.rint(np.where(valid, plane, 0)).astype(np.int64) for plane in (columns, rows))
        found = values[np.clip(v, 0, lens.H - 1), np.clip(u, 0, lens.W - 1)]
        out[band] = np.where(valid, found, missing)
    return out

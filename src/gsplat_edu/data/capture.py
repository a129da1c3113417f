"""The common form of all layouts: frames, points, and notes for the user."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import unreadable
from gsplat_edu.base.reading import kind_of
from gsplat_edu.data.images import PhotoFile
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.native_lens import WIDEST_PANORAMA, is_native, native_intrinsics
from gsplat_edu.data.notes import Note, UnusablePhotos
from gsplat_edu.data.panorama import FaceLens, face_rotations
from gsplat_edu.data.scale import Scale
from gsplat_edu.data.settings import FACTOR_BELOW, DataSettings
from gsplat_edu.photos.decoding import UPRIGHT, PhotoHeaders, upright_size
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.shutter import RollingShutter

ROTATION_SLACK = 1e-2
"""Largest entry of R R' - I that is accepted as a rotation written with few digits."""

MAX_COORDINATE = 1e12
"""Largest plausible coordinate, world units."""

OPAQUE_BEHIND = (0.0, 0.0, 0.0)
"""The background of photos without an alpha channel, which do not show it."""

READY_MADE = (2, 4, 8)
"""Factors of the folders images_2, images_4 and images_8 that are searched."""

PHOTO_FOLDERS = ("images", *(f"images_{factor}" for factor in READY_MADE))
"""Folders with the same photos in several sizes."""

PHOTO_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".heic", ".heif", ".hif")
"""Suffixes of photos, in any case."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One photo with its camera, as given by the capture.

    Args:
        name: The photo's name in the capture.
        image: The image file, which exists.
        lens: The camera's intrinsics; their size may differ from the file's.
        R: (3, 3) world-to-camera rotation, OpenCV axes.
        eye: (3,) camera centre, world units.
        mask: Image file that is zero for pixels that do not count.
        part: "train" or "test" if the capture assigns it, "left out" if it is missing from the capture's lists, else
            "".
        orientation: EXIF orientation by which the stored photo has to be turned to fit its pose; 1 for as stored.
        depth: File of the photo's depth map, if the capture names one; it may be missing.
        shutter: How the camera moved while the photo was read, if the capture says so. Rows are those of the upright
            photo.
    """

    name: str
    image: Path
    lens: Lens
    R: Float64[np.ndarray, "3 3"]
    eye: Float64[np.ndarray, "3"]
    mask: Path | None = None
    part: str = ""
    orientation: int = UPRIGHT
    depth: Path | None = None
    shutter: RollingShutter | None = None


@dataclass(frozen=True, eq=False)
class Cloud:
    """Initial points.

    Args:
        points: (N, 3) world units.
        colors: (N, 3) 0 to 1.
    """

    points: Float64[np.ndarray, "N 3"]
    colors: Float64[np.ndarray, "N 3"]


@dataclass(frozen=True, eq=False)
class Capture:
    """The contents of a capture folder.

    Args:
        layout: "COLMAP", "transforms.json", "Blender", or the name of another program or a plug-in.
        frames: In any order; at least one.
        cloud: The capture's points; None if it has none.
        notes: Facts that the user should know.
        no_cloud: The reason for missing points.
        cube: Half the edge of the cube around the origin that contains the scene, if the layout defines it.
        scale: What a unit of the coordinates is; None if unknown.
    """

    layout: str
    frames: tuple[Frame, ...]
    cloud: Cloud | None
    notes: tuple[Note, ...] = ()
    no_cloud: str = "the capture has no points"
    cube: float | None = None
    scale: Scale | None = None


def is_file(path: Path) -> bool:
    """Return whether a file exists; false for invalid names."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Return whether a folder exists; false for invalid names."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


POSE_PLACES = ("opensfm", "opf", "pose", "EXR_RGBD", "keyframes/corrected_cameras", "keyframes/cameras")
"""Folders in a capture where programs write their poses."""

MODEL_PLACE = re.compile(r"(?:/colmap)?/sparse(?:/[0-9]+)?\Z|/[0-9]+\Z")
"""The end of the path of a COLMAP model that is not the folder of its capture."""


def capture_folder(path: Path) -> Path:
    """Return the folder of a capture that is given by its folder or by its file with poses.

    Args:
        path: The folder, or a file in it or in one of `POSE_PLACES`; transforms.json and Blender's are in it; the list
            of images of a COLMAP model is where COLMAP puts models.
    """
    if is_folder(path):
        return path
    folder = path.parent.absolute()
    if path.stem == "images":
        return folder if is_folder(folder / "images") else Path(MODEL_PLACE.sub("", folder.as_posix()))
    for place in () if path.name.startswith("transforms") else POSE_PLACES:
        depth = place.count("/")
        if folder.as_posix().endswith(f"/{place}"):
            return folder.parents[depth]
    return path.parent


class Listings:
    """Names in the photo folders, each folder listed once.

    A capture may name hundreds of thousands of missing photos, each with 28 possible suffixes in four folders. Asking
    the system about every spelling would take minutes.
    """

    def __init__(self) -> None:
        self._known: dict[str, frozenset[str] | None] = {}

    def may_hold(self, path: str) -> bool:
        """Return whether a photo of that name may exist; if so, the system has to confirm it.

        Args:
            path: Path of the photo, with or without suffix. Case and the composition of accents are ignored, as on file
                systems that ignore both.
        """
        parent, name = os.path.split(path)
        if parent not in self._known:
            self._known[parent] = _folded_names(Path(parent))
        names = self._known[parent]
        return names is None or _folded(name) in names


def _folded(name: str) -> str:
    return name.lower() if name.isascii() else unicodedata.normalize("NFC", name).casefold()


def _folded_names(folder: Path) -> frozenset[str] | None:
    """List a folder and its counterparts with smaller copies of the photos; None if one cannot be listed."""
    names = set[str]()
    for place in (folder, *(copy for name in PHOTO_FOLDERS[1:] if (copy := _copy_place(folder, name)))):
        try:
            for name in os.listdir(place):  # noqa: PTH208 - only names are needed
                stem, dot, ending = name.rpartition(".")
                names.add(_folded(name))
                if f"{dot}{ending}".lower() in PHOTO_ENDINGS:
                    names.add(_folded(stem))
        except (FileNotFoundError, NotADirectoryError, ValueError):
            continue
        except OSError:
            return None
    return frozenset(names)


def is_outside(folder: Path, name: str) -> bool:
    """Return whether a path in a capture leads out of its folder; links are not followed.

    Args:
        folder: The capture.
        name: The path, relative to the folder or absolute, with slashes.
    """
    if ".." not in name and not PurePosixPath(name).is_absolute() and not PureWindowsPath(name).drive:
        return False
    place, top = os.path.abspath(folder / name), os.path.abspath(folder)  # noqa: PTH100 - resolves ".." lexically
    return not Path(place).is_relative_to(top)


def entries(folder: Path) -> list[Path]:
    """List a folder.

    Raises:
        DatasetError: the folder cannot be read.
    """
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise DatasetError(unreadable(folder, error)) from None


def missing_photo(name: str, places: Iterable[Path]) -> str:
    """Return how messages name a photo that has no file: with what is in its place, if that is a pipe or a device.

    Args:
        name: Its name.
        places: Where it should be.
    """
    kind = next((kind for place in places if (kind := kind_of(place)) is not None), None)
    return name if kind is None else f"{name} (it {kind}, not a file)"


def find_photo(path: Path) -> Path | None:
    """Find a photo: in images/, else its smaller copy in images_2, images_4 or images_8.

    Args:
        path: The path given by the capture.
    """
    if is_file(path):
        return path
    copies = (_copy(path, name) for name in PHOTO_FOLDERS[1:])
    return next((copy for copy in copies if copy is not None), None)


class UnfitPhotoError(DatasetError):
    """A photo does not fit its camera: another aspect ratio, or a lens that cannot be undistorted."""


class Problem(NamedTuple):
    """A photo whose pose or camera cannot be used."""

    name: str
    message: str  # names file, photo and problem
    reason: str  # the problem alone

    @classmethod
    def of(cls, name: str, where: str, error: DatasetError) -> Problem:
        """Return the problem that an error describes.

        Args:
            name: The photo's name.
            where: File and photo, with which the error's message begins.
            error: What is wrong.
        """
        return cls(name, str(error), error.reason.removeprefix(f"{where}: "))


def problem_notes(problems: Sequence[Problem], total: int) -> list[Note]:
    """Return the note about photos whose pose or camera cannot be used; empty if there are none.

    Args:
        problems: What is wrong with them.
        total: Number of photos with a file.

    Raises:
        DatasetError: no photo is usable.
    """
    if not problems:
        return []
    if len(problems) < total:
        return [UnusablePhotos(tuple((name, reason) for name, _, reason in problems), total)]
    rest = f"; none of the other {total - 1} photos has a usable pose and camera either" if total > 1 else ""
    raise DatasetError(f"{problems[0].message}{rest}; repair the file, or find the poses again")


def checked_frame(where: str, frame: Frame) -> Frame:
    """Check a pose, and restore the orthogonality of a rotation written with few digits.

    The nearest rotation in the least-squares sense is U V', with the singular value decomposition R = U S V'.

    Args:
        where: File and image, for messages.
        frame: The frame as read.

    Raises:
        DatasetError: a number is NaN, infinite or absurd, or R is not a rotation.
    """
    if not (np.all(np.abs(frame.eye) < MAX_COORDINATE) and np.all(np.isfinite(frame.R))):
        raise DatasetError(f"{where}: its pose is NaN, infinite or absurdly far away")
    if np.abs(frame.R).max() > 1e3:
        raise DatasetError(f"{where}: its pose is not a rotation; entries up to {np.abs(frame.R).max():g}")
    error = np.abs(frame.R @ frame.R.T - np.eye(3)).max()
    det = float(np.linalg.det(frame.R))
    if error > ROTATION_SLACK or det < 0:
        scale = abs(det) ** (1 / 3)
        uniform = scale > 0 and np.abs(frame.R @ frame.R.T / scale**2 - np.eye(3)).max() < ROTATION_SLACK
        what = "mirrors" if det < 0 else f"is scaled by {scale:.4g}" if uniform else "is not orthonormal"
        raise DatasetError(
            f"{where}: its rotation {what}; poses must consist of a rotation and a translation"
        )
    if error < 1e-12:
        return frame
    U, _, Vt = np.linalg.svd(frame.R)
    return replace(frame, R=U @ Vt)


def faces_of(frame: Frame) -> list[Frame]:
    """Return the faces of a panorama as frames, or the frame itself if it is none.

    Args:
        frame: The frame; its lens is a `FaceLens` if it is a panorama.
    """
    lens, path = frame.lens, PurePosixPath(frame.name)
    if not isinstance(lens, FaceLens):
        return [frame]
    return [
        replace(
            frame,
            name=str(path.with_name(f"{path.stem}_{number}{path.suffix}")),
            lens=replace(lens, number=number),
            R=R @ frame.R,
        )
        for number, R in enumerate(face_rotations())
    ]


def file_name(frame: Frame) -> str:
    """Return a frame's name in the capture's files: a face has that of its panorama."""
    if not isinstance(frame.lens, FaceLens):
        return frame.name
    path = PurePosixPath(frame.name)
    return str(path.with_name(path.stem.removesuffix(f"_{frame.lens.number}") + path.suffix))


def whole_panoramas(frames: Sequence[Frame]) -> list[Frame]:
    """Return frames with the faces of each panorama replaced by the panorama itself: the inverse of `faces_of`."""
    found = []
    for frame in frames:
        if not isinstance(frame.lens, FaceLens):
            found.append(frame)
        elif frame.lens.number == 0:
            found.append(replace(frame, name=file_name(frame), R=face_rotations()[0].T @ frame.R))
    return found


def photo_file(
    frame: Frame,
    settings: DataSettings,
    headers: PhotoHeaders,
) -> tuple[PhotoFile, Camera, bool]:
    """Determine a view's image file, how to load it, and the resulting camera.

    Args:
        frame: The frame.
        settings: Resolution, background, and which photos keep their lens.
        headers: Reads the files' headers.

    Returns:
        The photo; its camera of the final size, a pinhole at rest unless the photo keeps its lens or shutter; and
        whether the file's size differs from the frame's, in which case the intrinsics were rescaled.

    Raises:
        UnfitPhotoError: the photo has another aspect ratio than its camera, or cannot be undistorted.
        DatasetError: a file is not an image, or the sizes of photo and mask differ.
    """
    resolution = settings.resolution
    path, orientation = frame.image, frame.orientation
    size = upright_size(headers.size(path), orientation)
    rescaled = size != (frame.lens.W, frame.lens.H)
    lens = _fitted(frame, path, size)
    if frame.mask is not None and (mask_size := headers.size(frame.mask)) != size:
        reason = f"the mask is {_spelled(mask_size)} but its photo {_spelled(size)}"
        raise DatasetError(f"{frame.mask}: {reason}; make them one size", reason)
    W, H = _target(*size, resolution)
    # A mask has the size of the full photo, so a photo with a mask is always downscaled here.
    smaller = _smaller_copy(path, resolution) if frame.mask is None else None
    if smaller is not None:
        # A copy may be turned already, or have the photo's EXIF.
        path, orientation = smaller, UPRIGHT if orientation == UPRIGHT else headers.orientation(smaller)
        W, H = upright_size(headers.size(path), orientation)
        lens = _fitted(frame, path, (W, H))
    moving = frame.shutter is not None and settings.lens != "undistort"
    # what undistortion leaves of a photo's rows is curved, so a shutter needs the photo's own lens
    mode = "native" if moving else settings.lens
    kept = native_intrinsics(lens) if is_native(lens, mode) else None
    if kept is not None:
        if isinstance(lens, FaceLens) and resolution is None:
            W, H = _target(W, H, float(WIDEST_PANORAMA)) if W > WIDEST_PANORAMA else (W, H)
        seen = kept.scaled(W, H)
    else:
        try:
            seen = lens.undistorted()
            if isinstance(lens, FaceLens):
                W, H = _target(seen.W, seen.H, resolution if smaller is None else None)
            seen = seen.scaled(W, H)
        except DatasetError as error:
            raise UnfitPhotoError(f"{frame.name}: {error}", error.reason) from None
    # an opaque file has no alpha to keep, so none is counted as needing memory
    background = settings.background if headers.of(path).alpha else OPAQUE_BEHIND
    source = PhotoFile(path, frame.mask, lens, W, H, background, orientation, native=kept is not None)
    shutter = frame.shutter if moving and not source.resampled else None
    camera = Camera.posed(frame.R, frame.eye, seen, shutter)
    return source, camera, rescaled


def fits_camera(lens: Lens, size: tuple[int, int]) -> bool:
    """Return whether a photo of a size has its camera's aspect ratio, up to rounding.

    Args:
        lens: The camera.
        size: Width and height of the photo, px.
    """
    W, H = size
    # Both sizes may have been rounded by up to a pixel of the smaller one of photo and camera.
    slack = max(1.0, W / lens.W) * (1.0 + lens.H / lens.W)
    return abs(H - lens.H * W / lens.W) <= slack


def _fitted(frame: Frame, path: Path, size: tuple[int, int]) -> Lens:
    """Return the lens scaled to the file's size."""
    (W, H), lens = size, frame.lens
    if not fits_camera(lens, size):
        what = f"is {_spelled(size)} but its camera {lens.W}x{lens.H}, another aspect ratio"
        raise UnfitPhotoError(
            f"{path}: the photo of {frame.name} {what}; was the photo cropped or turned after the poses were found?",
            f"the photo {what}",
        )
    return _scaled(lens, W, H)


@lru_cache(maxsize=4096)
def _scaled(lens: Lens, W: int, H: int) -> Lens:
    """Scale a lens, with a cache: the frames of a capture share a few lenses."""
    return lens.scaled(W, H)


def _target(W: int, H: int, resolution: float | None) -> tuple[int, int]:
    if resolution is None:
        return W, H
    factor = resolution if resolution < FACTOR_BELOW else max(1.0, max(W, H) / resolution)
    return max(1, round(W / factor)), max(1, round(H / factor))


def _smaller_copy(path: Path, resolution: float | None) -> Path | None:
    """Find images_4/NAME next to images/NAME for resolution 4."""
    return _copy(path, f"images_{resolution:.0f}") if resolution in READY_MADE else None


def _copy(path: Path, name: str) -> Path | None:
    """Find the same photo in another of these folders."""
    place = _copy_place(path.parent, name)
    return copy if place is not None and is_file(copy := place / path.name) else None


def _copy_place(parent: Path, name: str) -> Path | None:
    """Return the counterpart of a photo folder that holds smaller copies."""
    for folder in (parent, *parent.parents):
        if folder.name in PHOTO_FOLDERS:
            return folder.with_name(name) / parent.relative_to(folder)
    return None


def unit_colors(colors: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Clamp colours to 0..1; NaN becomes mid-grey."""
    return np.asarray(np.clip(np.nan_to_num(colors, nan=0.5), 0.0, 1.0))


def _spelled(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"

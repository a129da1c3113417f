"""What every layout is read into: frames, points, and what the user should know about them."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
from jaxtyping import Float64

from gsplat_edu.camera import Camera
from gsplat_edu.data.images import PhotoFile, image_size
from gsplat_edu.data.lens import Lens, straightened
from gsplat_edu.data.notes import Note
from gsplat_edu.errors import DatasetError

ROTATION_SLACK = 1e-2
"""Largest entry of R R' - I in a file that is still taken for a rotation written with few digits."""

MAX_COORDINATE = 1e12
"""Largest coordinate that is believed, world units."""

FACTOR_BELOW = 32
"""A resolution below this divides the size; from here on it is the longest side, px."""

READY_MADE = (2, 4, 8)
"""Factors for which a folder images_2, images_4 or images_8 is looked for."""

PHOTO_FOLDERS = ("images", *(f"images_{factor}" for factor in READY_MADE))
"""Folders that hold the same photos in several sizes."""

PHOTO_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".heic")
"""What names of photos end in, in any case."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One photo with its camera, as the capture states them.

    Args:
        name: What the capture calls it.
        image: The image file, which exists.
        lens: The camera's intrinsics; its size may not be the file's.
        R: (3, 3) world-to-camera rotation, OpenCV axes.
        eye: (3,) camera centre, world units.
        mask: Image file that is zero where a pixel does not count.
        part: "train" or "test" where the capture says so, "left out" where it lists others only, else "".
    """

    name: str
    image: Path
    lens: Lens
    R: Float64[np.ndarray, "3 3"]
    eye: Float64[np.ndarray, "3"]
    mask: Path | None = None
    part: str = ""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points to start from.

    Args:
        points: (N, 3) world units.
        colors: (N, 3) 0 to 1.
    """

    points: Float64[np.ndarray, "N 3"]
    colors: Float64[np.ndarray, "N 3"]


@dataclass(frozen=True, eq=False)
class Capture:
    """What a folder holds.

    Args:
        layout: "COLMAP", "transforms.json" or "Blender".
        frames: In any order; at least one.
        cloud: The capture's points; None where it has none.
        notes: What the user should know of it.
        no_cloud: Why there are no points, where there are none.
        cube: Half the edge of the cube around the origin that holds the scene, where the layout fixes it.
    """

    layout: str
    frames: tuple[Frame, ...]
    cloud: Cloud | None
    notes: tuple[Note, ...] = ()
    no_cloud: str = "the capture has no points"
    cube: float | None = None


def is_file(path: Path) -> bool:
    """Say whether a file is there; names that no file can have are not."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Say whether a folder is there; names that no folder can have are not."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


class Listings:
    """The names in the folders of photos, each folder listed once.

    A capture may name hundreds of thousands of photos that are not there, each of which could have twenty-two endings
    in four folders. Asking the system about every spelling takes minutes.
    """

    def __init__(self) -> None:
        self._known: dict[str, frozenset[str] | None] = {}

    def may_hold(self, path: str) -> bool:
        """Say whether a photo of that name can be there; the system then has to say that it is.

        Args:
            path: Path of the photo, with or without its ending. Case does not matter, nor how accents are composed, as
                on file systems that ignore both.
        """
        parent, name = os.path.split(path)
        if parent not in self._known:
            self._known[parent] = _folded_names(Path(parent))
        names = self._known[parent]
        return names is None or _folded(name) in names


def _folded(name: str) -> str:
    return name.lower() if name.isascii() else unicodedata.normalize("NFC", name).casefold()


def _folded_names(folder: Path) -> frozenset[str] | None:
    """List a folder and those with smaller copies of its photos; None where one cannot be listed."""
    names = set[str]()
    for place in (folder, *(copy for name in PHOTO_FOLDERS[1:] if (copy := _copy_place(folder, name)))):
        try:
            for name in os.listdir(place):  # noqa: PTH208 - names are enough
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
    """Say whether a path that a capture names leads out of its folder; links are not followed.

    Args:
        folder: The capture.
        name: The path, relative to the folder or absolute, with slashes.
    """
    if ".." not in name and not PurePosixPath(name).is_absolute() and not PureWindowsPath(name).drive:
        return False
    place, top = os.path.abspath(folder / name), os.path.abspath(folder)  # noqa: PTH100 - it folds ".." lexically
    return not Path(place).is_relative_to(top)


def entries(folder: Path) -> list[Path]:
    """List a folder.

    Raises:
        DatasetError: it cannot be read.
    """
    try:
        return sorted(folder.iterdir())
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be read ({error.strerror}); check its permissions") from None


def find_photo(path: Path) -> Path | None:
    """Find a photo; where it is not in images/, the smaller one of images_2, images_4 or images_8.

    Args:
        path: Where the capture says it is.
    """
    if is_file(path):
        return path
    copies = (_copy(path, name) for name in PHOTO_FOLDERS[1:])
    return next((copy for copy in copies if copy is not None), None)


def checked_frame(where: str, frame: Frame) -> Frame:
    """Check a pose, and make a rotation that lost digits one again.

    The nearest rotation in the least-squares sense is U V' of the singular value decomposition U S V' = R.

    Args:
        where: File and image, for the message.
        frame: As read.

    Raises:
        DatasetError: a number is NaN, infinite or absurd, or R is not a rotation.
    """
    if not (np.all(np.abs(frame.eye) < MAX_COORDINATE) and np.all(np.isfinite(frame.R))):
        raise DatasetError(
            f"{where}: its pose is NaN, infinite or absurdly far; take the image out of the capture"
        )
    if np.abs(frame.R).max() > 1e3:
        raise DatasetError(f"{where}: its pose is not a rotation; entries up to {np.abs(frame.R).max():g}")
    error = np.abs(frame.R @ frame.R.T - np.eye(3)).max()
    det = float(np.linalg.det(frame.R))
    if error > ROTATION_SLACK or det < 0:
        scale = abs(det) ** (1 / 3)
        uniform = scale > 0 and np.abs(frame.R @ frame.R.T / scale**2 - np.eye(3)).max() < ROTATION_SLACK
        what = "mirrors" if det < 0 else f"is scaled by {scale:.4g}" if uniform else "is not orthonormal"
        raise DatasetError(f"{where}: its rotation {what}; poses have to be a rotation and a translation")
    if error < 1e-12:
        return frame
    U, _, Vt = np.linalg.svd(frame.R)
    return replace(frame, R=U @ Vt)


def photo_file(
    frame: Frame,
    resolution: float | None,
    background: tuple[float, float, float] | None,
    size_of: Callable[[Path], tuple[int, int]] = image_size,
) -> tuple[PhotoFile, Camera, bool]:
    """Work out which file a view is read from, how, and the camera that goes with the result.

    Args:
        frame: The frame.
        resolution: Below `FACTOR_BELOW` what to divide the size by, else the longest side, px; None: as it is.
        background: As for `PhotoFile`.
        size_of: Reads the size of an image file; one that remembers saves time where frames share files.

    Returns:
        The photo; its camera, a pinhole of the final size; whether the file has another size than the frame
        says, so that the intrinsics were rescaled.

    Raises:
        DatasetError: a file is no image, the sizes of photo, mask and camera do not fit, or the distortion
            cannot be undone.
    """
    path = frame.image
    size = size_of(path)
    rescaled = size != (frame.lens.W, frame.lens.H)
    lens = _fitted(frame, path, size)
    if frame.mask is not None and (mask_size := size_of(frame.mask)) != size:
        reason = f"the mask is {_spelled(mask_size)} but its photo {_spelled(size)}"
        raise DatasetError(f"{frame.mask}: {reason}; make them one size", reason)
    W, H = _target(*size, resolution)
    # A mask has the size of the full photo, so a photo that has one is always downscaled here.
    smaller = _smaller_copy(path, resolution) if frame.mask is None else None
    if smaller is not None:
        path = smaller
        W, H = size_of(path)
        lens = _fitted(frame, path, (W, H))
    try:
        pinhole = _resized(straightened(lens), W, H)
    except DatasetError as error:
        raise DatasetError(f"{frame.name}: {error}", error.reason) from None
    camera = Camera(frame.R, frame.eye, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, H, W)
    return PhotoFile(path, frame.mask, lens, W, H, background), camera, rescaled


def _fitted(frame: Frame, path: Path, size: tuple[int, int]) -> Lens:
    """Return the lens at the size the file has."""
    (W, H), lens = size, frame.lens
    # Both sizes may have been rounded by up to a pixel, of the smaller of photo and camera.
    slack = max(1.0, W / lens.W) * (1.0 + lens.H / lens.W)
    if abs(H - lens.H * W / lens.W) > slack:
        what = f"is {_spelled(size)} but its camera {lens.W}x{lens.H}, another aspect ratio"
        raise DatasetError(
            f"{path}: the photo of {frame.name} {what}; was the photo cropped or turned after the poses were found?",
            f"the photo {what}",
        )
    return _resized(lens, W, H)


@lru_cache(maxsize=4096)
def _resized(lens: Lens, W: int, H: int) -> Lens:
    """Resize a lens; the frames of a capture share a few."""
    return lens.resized(W, H)


def _target(W: int, H: int, resolution: float | None) -> tuple[int, int]:
    if resolution is None:
        return W, H
    factor = resolution if resolution < FACTOR_BELOW else max(1.0, max(W, H) / resolution)
    return max(1, round(W / factor)), max(1, round(H / factor))


def _smaller_copy(path: Path, resolution: float | None) -> Path | None:
    """Find images_4/NAME beside images/NAME for resolution 4."""
    return _copy(path, f"images_{resolution:.0f}") if resolution in READY_MADE else None


def _copy(path: Path, name: str) -> Path | None:
    """Find the same photo in another of the folders."""
    place = _copy_place(path.parent, name)
    return copy if place is not None and is_file(copy := place / path.name) else None


def _copy_place(parent: Path, name: str) -> Path | None:
    """Return the folder that corresponds to a folder of photos among their smaller copies."""
    for folder in (parent, *parent.parents):
        if folder.name in PHOTO_FOLDERS:
            return folder.with_name(name) / parent.relative_to(folder)
    return None


def unit_colors(colors: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Bring colours to the range 0 to 1; what is NaN becomes mid-gray."""
    return np.asarray(np.clip(np.nan_to_num(colors, nan=0.5), 0.0, 1.0))


def _spelled(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"

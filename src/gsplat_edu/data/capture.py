"""What every layout is read into: frames, points, and what the user should know about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsplat_edu.camera import Camera
from gsplat_edu.data.images import PhotoFile, image_size
from gsplat_edu.data.lens import Lens, straightened
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
        notes: Sentences for the user.
        no_cloud: Why there are no points, where there are none.
        cube: Half the edge of the cube around the origin that holds the scene, where the layout fixes it.
    """

    layout: str
    frames: tuple[Frame, ...]
    cloud: Cloud | None
    notes: tuple[str, ...] = ()
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


def missing_note(missing: Sequence[str], total: int) -> str:
    """Say how many photos have no file."""
    return f"{len(missing)} of {total} photos have no file: skipped, first {missing[0]}"


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
    frame: Frame, resolution: float | None, background: tuple[float, float, float] | None
) -> tuple[PhotoFile, Camera, bool]:
    """Work out which file a view is read from, how, and the camera that goes with the result.

    Args:
        frame: The frame.
        resolution: Below `FACTOR_BELOW` what to divide the size by, else the longest side, px; None: as it is.
        background: As for `PhotoFile`.

    Returns:
        The photo; its camera, a pinhole of the final size; whether the file has another size than the frame
        says, so that the intrinsics were rescaled.

    Raises:
        DatasetError: a file is no image, the sizes of photo, mask and camera do not fit, or the distortion
            cannot be undone.
    """
    path = frame.image
    size = image_size(path)
    rescaled = size != (frame.lens.W, frame.lens.H)
    lens = _fitted(frame, path, size)
    if frame.mask is not None and (mask_size := image_size(frame.mask)) != size:
        raise DatasetError(
            f"{frame.mask}: the mask is {_spelled(mask_size)} but its photo {_spelled(size)}; make them one size"
        )
    W, H = _target(*size, resolution)
    # A mask has the size of the full photo, so a photo that has one is always downscaled here.
    smaller = _smaller_copy(path, resolution) if frame.mask is None else None
    if smaller is not None:
        path = smaller
        W, H = image_size(path)
        lens = _fitted(frame, path, (W, H))
    try:
        pinhole = straightened(lens).resized(W, H)
    except DatasetError as error:
        raise DatasetError(f"{frame.name}: {error}") from None
    camera = Camera(frame.R, frame.eye, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, H, W)
    return PhotoFile(path, frame.mask, lens, W, H, background), camera, rescaled


def _fitted(frame: Frame, path: Path, size: tuple[int, int]) -> Lens:
    """Return the lens at the size the file has."""
    (W, H), lens = size, frame.lens
    # Both sizes may have been rounded by up to a pixel, of the smaller of photo and camera.
    slack = max(1.0, W / lens.W) * (1.0 + lens.H / lens.W)
    if abs(H - lens.H * W / lens.W) > slack:
        raise DatasetError(
            f"{path}: the photo of {frame.name} is {_spelled(size)} but its camera {lens.W}x{lens.H}, another aspect "
            "ratio; was the photo cropped or turned after the poses were found?"
        )
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
    for folder in path.parents:
        if folder.name in PHOTO_FOLDERS:
            copy = folder.with_name(name) / path.relative_to(folder)
            return copy if is_file(copy) else None
    return None


def unit_colors(colors: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Bring colours to the range 0 to 1; what is NaN becomes mid-gray."""
    return np.asarray(np.clip(np.nan_to_num(colors, nan=0.5), 0.0, 1.0))


def _spelled(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"

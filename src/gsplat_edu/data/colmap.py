"""COLMAP's sparse models: cameras, images and points3D, as .bin or .txt.

World and camera axes match this project's. Quaternions are (w, x, y, z) and rotate world into camera coordinates, x_cam
= R x + t, so the camera centre is -R' t. The contents of rigs.bin and frames.bin of newer versions are also in
images.bin, so those files are not read.

Source: COLMAP's documentation, "Output Format" and "Camera Models".
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gsplat_edu.data.capture import (
    Capture,
    Cloud,
    Frame,
    Listings,
    checked_frame,
    entries,
    faces_of,
    find_photo,
    is_file,
    is_folder,
    is_outside,
    unit_colors,
)
from gsplat_edu.data.lens import FISHEYE, PINHOLE_LIKE, Lens, lens_of
from gsplat_edu.data.notes import FilesOutside, MissingPhotos, Note, OtherModels, UnclearMasks
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.errors import DatasetError
from gsplat_edu.files import unreadable
from gsplat_edu.gaussian_math import quat_to_R
from gsplat_edu.reading import read_bytes, read_text
from gsplat_edu.text import legible

MODELS: tuple[tuple[str, str], ...] = (
    ("SIMPLE_PINHOLE", "f cx cy"),
    ("PINHOLE", "fx fy cx cy"),
    ("SIMPLE_RADIAL", "f cx cy k1"),
    ("RADIAL", "f cx cy k1 k2"),
    ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    ("FOV", "fx fy cx cy omega"),
    ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    ("SIMPLE_DIVISION", "f cx cy k"),
    ("DIVISION", "fx fy cx cy k"),
    ("SIMPLE_FISHEYE", "f cx cy"),
    ("FISHEYE", "fx fy cx cy"),
    ("EUCM", "fx fy cx cy alpha beta"),
    ("EQUIRECTANGULAR", "w h"),
)
"""COLMAP's camera models by number, with their parameters."""

SPHERE = "EQUIRECTANGULAR"
"""The model whose images show all directions; they are read as several faces."""

FORMULA_OF = {
    "FOV": "field of view",
    "THIN_PRISM_FISHEYE": "thin prism fisheye",
    "RAD_TAN_THIN_PRISM_FISHEYE": "radial tangential prism fisheye",
    "SIMPLE_DIVISION": "division",
    "DIVISION": "division",
    "EUCM": "enhanced unified",
}
"""Formulas of the models that are neither perspective nor, by their names, a fisheye."""

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
"""Locations of a model in a capture, in search order; after these, numbered folders in sparse, colmap/sparse and the
capture itself are searched."""

SUFFIXES = (".bin", ".txt")


class Pose(NamedTuple):
    """An image of a model."""

    name: str
    camera: int
    quat: tuple[float, ...]  # (w, x, y, z), world to camera
    shift: tuple[float, ...]  # world units


def find_model(folder: Path) -> Path | None:
    """Find the folder of a model, by its cameras or images file.

    Args:
        folder: The capture, its folder of models, or the model.
    """
    places = [folder / place for place in PLACES]
    for parent in (folder / "sparse", folder / "colmap" / "sparse", folder):
        places += _numbered(parent)
    names = [f"{part}{suffix}" for part in ("cameras", "images") for suffix in SUFFIXES]
    return next((place for place in places if any(is_file(place / name) for name in names)), None)


def read_colmap(folder: Path, model: Path) -> Capture:
    """Read a capture with poses from COLMAP.

    Args:
        folder: The capture, with the photos in images/ or next to the model.
        model: The folder with cameras, images and optionally points3D.

    Raises:
        DatasetError: a file is missing, truncated or malformed; a camera model is unsupported; a pose is invalid; two
            images share one file; or no image has a file.
    """
    suffix = _suffix(model)
    listed = model / f"images{suffix}"
    poses = read_images(listed)
    if not poses:
        raise DatasetError(f"{listed}: lists no images; run COLMAP's mapper, or choose another model")
    photos, masks, notes = _files(folder, model, [pose.name for pose in poses])
    there = [pose for pose in poses if pose.name in photos]
    missing = [legible(pose.name) for pose in poses if pose.name not in photos]
    if not there:
        raise DatasetError(
            f"{folder}: none of the {len(poses)} photos listed in {listed.name} has a file, first {missing[0]}; put "
            "them into images/"
        )
    lenses = read_cameras(model / f"cameras{suffix}", {pose.camera for pose in there})
    frames = []
    for pose in there:
        name = legible(pose.name)
        where = f"{listed}, image {name}"
        if pose.camera not in lenses:
            raise DatasetError(
                f"{where}: its camera {pose.camera} is not in cameras{suffix}; the two files do not belong together"
            )
        R, eye = _placed(where, pose)
        frame = Frame(name, photos[pose.name], lenses[pose.camera], R, eye, masks.get(pose.name))
        frames += faces_of(checked_frame(where, frame))
    if missing:
        notes.append(MissingPhotos(len(missing), len(poses), missing[0]))
    others = [place.name for place in _numbered(model.parent) if place != model]
    if model.name.isdecimal() and others and (model.parent == folder or model.parent.name == "sparse"):
        notes.append(OtherModels(model.parent, model.name, tuple(others)))
    return Capture("COLMAP", tuple(frames), read_points(model), tuple(notes))


def points_file(model: Path) -> Path | None:
    """Find a model's file of points, .bin or .txt, independent of the suffix of its other files."""
    paths = (model / f"points3D{suffix}" for suffix in SUFFIXES)
    return next((path for path in paths if is_file(path)), None)


def read_points(model: Path) -> Cloud | None:
    """Read a model's points; return None if the file is missing or empty.

    Args:
        model: The folder with points3D.bin or points3D.txt.

    Raises:
        DatasetError: the file is truncated or malformed.
    """
    path = points_file(model)
    if path is None:
        return None
    rows = _points_bin(path) if path.suffix == ".bin" else _points_txt(path)
    if not rows:
        return None
    table = np.array(rows, dtype=np.float64)
    return Cloud(table[:, :3], unit_colors(table[:, 3:] / 255.0))


def read_cameras(path: Path, used: Container[int] | None = None) -> dict[int, Lens]:
    """Read the lenses of a model, by camera number.

    Args:
        path: cameras.bin or cameras.txt.
        used: Numbers of the required cameras; None for all. Other cameras may be unsupported.

    Raises:
        DatasetError: the file is truncated or malformed, or a required camera model is unsupported.
    """
    lenses = {}
    for where, camera, model, W, H, values in (
        _cameras_bin(path) if path.suffix == ".bin" else _cameras_txt(path)
    ):
        if used is not None and camera not in used:
            continue
        try:
            lenses[camera] = _lens(model, W, H, values)
        except DatasetError as error:
            raise DatasetError(f"{where}: {error}") from None
    return lenses


def read_images(path: Path) -> list[Pose]:
    """Read names and poses, in the order of the file.

    Args:
        path: images.bin or images.txt.

    Raises:
        DatasetError: the file is truncated or malformed.
    """
    return _images_bin(path) if path.suffix == ".bin" else _images_txt(path)


def _suffix(model: Path) -> str:
    for suffix in SUFFIXES:
        if is_file(model / f"cameras{suffix}") and is_file(model / f"images{suffix}"):
            return suffix
    raise DatasetError(f"{model}: needs both cameras and images, as .bin or as .txt; copy the whole model")


def _numbered(folder: Path) -> list[Path]:
    """List the folders whose names are numbers, in ascending order."""
    if not is_folder(folder):
        return []
    return sorted(
        (p for p in entries(folder) if p.name.isdecimal() and is_folder(p)), key=lambda p: int(p.name)
    )


def _photo_folders(folder: Path, model: Path) -> tuple[list[Path], list[Path]]:
    """Return the possible folders of photos, and of masks."""
    photos, masks = [folder / "images", folder], [folder / "masks"]
    if model == folder or (model.parent == folder and model.name.isdecimal()):
        # The model or its parent folder was given; its photos are where they would be for the capture.
        above = folder.absolute().parents[:2]
        photos += [parent / "images" for parent in above]
        masks += [parent / "masks" for parent in above]
    return photos, masks


def _files(
    folder: Path, model: Path, names: Sequence[str]
) -> tuple[dict[str, Path], dict[str, Path], list[Note]]:
    """Find photos and masks by the names of the images, and report unused files.

    A file outside the folders of its image's name is used if no other image has the same bare name.

    Raises:
        DatasetError: two images share one file.
    """
    photo_folders, mask_folders = _photo_folders(folder, model)
    mask_folders = [place for place in mask_folders if is_folder(place)]
    listings = Listings()
    bare = Counter(Path(name).name for name in names)
    photos, masks, unclear = dict[str, Path](), dict[str, Path](), list[str]()
    for name in names:
        last = Path(name).name
        alone = [last] if bare[last] == 1 else []
        places = [p for p in _candidates(photo_folders, name, alone) if listings.may_hold(str(p))]
        # Photos of full size first, in any folder; then those of images_2, images_4 and images_8.
        photo = next((p for find in (_present, find_photo) for p in map(find, places) if p), None)
        mask = next((p for p in _masks(mask_folders, [name, *alone]) if is_file(p)), None)
        if photo is not None:
            photos[name] = photo
        if mask is not None:
            masks[name] = mask
        elif not alone and any(is_file(p) for p in _masks(mask_folders, [last])):
            unclear.append(legible(name))
    _check_single(model, names, photos)
    _check_single(model, names, masks)
    notes = list[Note]()
    outside = [photos[name] for name in names if name in photos and is_outside(folder, name)]
    if outside:
        notes.append(FilesOutside(outside[0], len(outside), folder))
    if unclear:
        notes.append(UnclearMasks(len(unclear), len(names), unclear[0]))
    return photos, masks, notes


def _present(path: Path) -> Path | None:
    return path if is_file(path) else None


def _check_single(model: Path, names: Sequence[str], files: Mapping[str, Path]) -> None:
    """Reject two images with one name or one file."""
    owners: dict[Path, str] = {}
    for name in names:
        if name not in files:
            continue
        if files[name] not in owners:
            owners[files[name]] = name
        elif (other := owners[files[name]]) == name:
            raise DatasetError(f"{model}: lists the image {legible(name)} twice; export the model again")
        else:
            raise DatasetError(
                f"{files[name]}: is the file of two images, {legible(other)} and {legible(name)}; put each "
                "at the path given by its full name"
            )


def _candidates(folders: Sequence[Path], name: str, alone: Sequence[str]) -> Iterator[Path]:
    yield from (folder / name for folder in folders)
    yield from (folder / last for last in alone for folder in folders if folder.name == "images")


def _masks(folders: Sequence[Path], names: Sequence[str]) -> Iterator[Path]:
    for folder in folders:
        for name in names:
            yield folder / f"{name}.png"
            if Path(name).name:
                yield (folder / name).with_suffix(".png")


def _name(raw: bytes) -> str:
    """Decode a file name for the system's functions, with slashes."""
    return os.fsdecode(raw).replace("\\", "/")


def _placed(where: str, pose: Pose) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    shift = np.array(pose.shift)
    if not np.all(np.abs(shift) < 1e100):  # the rest is checked by checked_frame
        raise DatasetError(f"{where}: its pose is NaN or infinite; remove the image from the model")
    if not np.all(np.isfinite(pose.quat)) or not np.any(pose.quat):
        raise DatasetError(
            f"{where}: its quaternion {pose.quat} is not a rotation; remove the image from the model"
        )
    R = quat_to_R(pose.quat)
    return R, -R.T @ shift


def _lens(model: str, W: int, H: int, values: Sequence[float]) -> Lens:
    names = dict(MODELS).get(model, "").split()
    if not names:
        raise DatasetError(
            f"camera model {model} is not supported; run `colmap image_undistorter` and load its output"
        )
    if len(values) != len(names):
        raise DatasetError(f"{model} has {len(names)} parameters ({', '.join(names)}), got {len(values)}")
    if model == SPHERE:
        return FaceLens.of(W, H, 0)
    named = dict(zip(names, values, strict=True))
    if "f" in named:
        named["fx"] = named["fy"] = named.pop("f")
    plain = FISHEYE if model.endswith("FISHEYE") else PINHOLE_LIKE
    return lens_of(named, W, H, FORMULA_OF.get(model, plain))


class _Binary:
    """Reads little-endian numbers from a file that may be truncated."""

    def __init__(self, path: Path, smallest: int) -> None:
        self.path, self.at, self.where = path, 0, "its header"
        try:
            self.data = read_bytes(path)
        except OSError as error:
            raise DatasetError(unreadable(path, error)) from None
        (self.count,) = self.take(struct.Struct("<Q"))
        if self.count * smallest > len(self.data) - self.at:
            raise self.corrupt(f"its header declares {self.count} entries, more than the file can contain")

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Read the numbers of a struct layout."""
        if self.at + layout.size > len(self.data):
            raise self.corrupt(f"it ends inside {self.where}")
        self.at += layout.size
        return layout.unpack_from(self.data, self.at - layout.size)

    def skip(self, count: int, size: int) -> None:
        """Skip `count` entries of `size` bytes."""
        if count * size > len(self.data) - self.at:
            raise self.corrupt(f"it ends inside {self.where}")
        self.at += count * size

    def word(self) -> str:
        """Read a zero-terminated name."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.corrupt(f"it ends inside {self.where}")
        raw, self.at = self.data[self.at : end], end + 1
        return _name(raw)

    def corrupt(self, what: str) -> DatasetError:
        """Return the error for a damaged file."""
        return DatasetError(f"{self.path}: {what}; the file is truncated or corrupt, copy it again")


_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3BdQ")
_COUNT = struct.Struct("<Q")
_CameraRow = tuple[str, int, str, int, int, tuple[float, ...]]


def _cameras_bin(path: Path) -> Iterator[_CameraRow]:
    file = _Binary(path, _CAMERA.size)
    for _ in range(file.count):
        file.where = "a camera"
        camera, kind, W, H = file.take(_CAMERA)
        file.where = f"camera {camera}"
        where = f"{path}, camera {camera}"
        if not 0 <= kind < len(MODELS):
            raise DatasetError(
                f"{where}: camera model number {kind} is unknown; run `colmap image_undistorter` and load its output"
            )
        model, names = MODELS[kind]
        values = file.take(struct.Struct(f"<{len(names.split())}d"))
        yield where, camera, model, W, H, values


def _images_bin(path: Path) -> list[Pose]:
    file, poses = _Binary(path, _IMAGE.size + 1 + _COUNT.size), []
    for number in range(file.count):
        file.where = f"image {number + 1} of {file.count}"
        _, *pose, camera = file.take(_IMAGE)
        name = file.word()
        file.skip(file.take(_COUNT)[0], 24)
        poses.append(Pose(name, camera, tuple(pose[:4]), tuple(pose[4:])))
    return poses


def _points_bin(path: Path) -> list[tuple[float, ...]]:
    file, rows = _Binary(path, _POINT.size), list[tuple[float, ...]]()
    for number in range(file.count):
        file.where = f"point {number + 1} of {file.count}"
        row = file.take(_POINT)
        file.skip(row[-1], 8)
        rows.append(row[1:7])
    return rows


def _lines(path: Path) -> list[str]:
    try:
        return read_text(path, errors="surrogateescape").split("\n")
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None


def _malformed(path: Path, number: int, expected: str) -> DatasetError:
    return DatasetError(f"{path}, line {number}: expected {expected}; the file is malformed, export it again")


def _cameras_txt(path: Path) -> Iterator[_CameraRow]:
    for number, line in enumerate(_lines(path), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            camera, model, W, H, *values = words
            yield (
                f"{path}, line {number}",
                int(camera),
                model,
                int(W),
                int(H),
                tuple(float(v) for v in values),
            )
        except ValueError:
            raise _malformed(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None


def _images_txt(path: Path) -> list[Pose]:
    poses, lines = list[Pose](), enumerate(_lines(path), 1)
    for number, line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        try:
            _, *pose, camera, name = words
            values = [float(v) for v in pose]
            if len(values) != 7:
                raise ValueError
            file = _name(name.strip().encode("utf-8", "surrogateescape"))
            poses.append(Pose(file, int(camera), tuple(values[:4]), tuple(values[4:])))
        except ValueError:
            raise _malformed(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
        # The image's 2D points follow on their own line, which may be empty but is always present.
        _, observed = next(lines, (number + 1, ""))
        if len(observed.split()) % 3:
            raise _malformed(path, number + 1, "the image's points as X Y POINT3D_ID, or an empty line")
    return poses


def _points_txt(path: Path) -> list[tuple[float, ...]]:
    rows = []
    for number, line in enumerate(_lines(path), 1):
        words = line.split(maxsplit=7)
        if not words or words[0].startswith("#"):
            continue
        try:
            if len(words) < 8:
                raise ValueError
            rows.append(tuple(float(v) for v in words[1:7]))
        except ValueError:
            raise _malformed(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK") from None
    return rows

"""transforms.json, in the dialects of nerfstudio and instant-ngp.

`transform_matrix` maps camera to world coordinates with OpenGL's camera axes (+x right, +y up, +z backward). Its y and
z columns are negated here, once, which gives OpenCV's axes. World coordinates stay unchanged.

Source: nerfstudio's documentation, "Data conventions"; instant-ngp's "nerf_dataset_tips".
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import unreadable
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.text import as_file_name, legible
from gsplat_edu.data.capture import (
    PHOTO_ENDINGS,
    Capture,
    Cloud,
    Frame,
    Listings,
    Problem,
    checked_frame,
    find_photo,
    is_file,
    is_outside,
    missing_photo,
    problem_notes,
)
from gsplat_edu.data.colmap import find_model, points_file, read_points
from gsplat_edu.data.lens import FISHEYE, PINHOLE_LIKE, Lens, lens_of
from gsplat_edu.data.masks import with_masks
from gsplat_edu.data.notes import FilesOutside, MissingPhotos, Note, RepeatedPhotos
from gsplat_edu.data.points import read_points_ply
from gsplat_edu.data.shutter_keys import SHUTTER_KEYS, shutter_from_keys
from gsplat_edu.photos.decoding import image_size

FISHEYE_MODEL = "OPENCV_FISHEYE"

CAMERA_MODELS = ("OPENCV", FISHEYE_MODEL, "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""Supported values of `camera_model`; OPENCV is the default. All except the fisheye are OPENCV with some coefficients
zero."""

FOCAL_KEYS = {axis: (f"fl_{axis}", f"camera_angle_{axis}") for axis in "xy"}
"""Keys of the focal length: in px, or as a field of view."""

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

INTRINSICS = frozenset(
    ("w", "h", "cx", "cy", "camera_model", "is_fisheye", *COEFFICIENTS, *FOCAL_KEYS["x"], *FOCAL_KEYS["y"])
)
"""Keys that determine a lens."""

SAME_POSE = 1e-6
"""Largest difference of entries of one pose, written with different numbers of digits; of centres relative to their
size."""


class Found(NamedTuple):
    """Contents of a file."""

    frames: list[Frame]
    missing: list[str]
    """Names of photos without a file."""
    outside: list[Path]
    """Photos, masks and depth maps outside the file's folder."""
    problems: list[Problem]
    """Photos whose pose or camera cannot be used."""


def read_transforms(path: Path) -> Capture:
    """Read a capture whose poses are in a transforms.json.

    Args:
        path: The file; its paths are relative to its folder.

    Frames whose pose or camera is NaN, infinite or absurd are left out, and named in a note. A photo that is listed
    more than once is used once; see `each_once`.

    Raises:
        DatasetError: the file is not JSON or incomplete, a camera model is unsupported, or no frame has a photo and a
            usable pose and camera.
    """
    contents = read_json(path)
    frames, missing, outside, problems = read_frames(path, contents)
    if not frames and not problems:
        raise nothing_found(path, missing)
    frames, notes = each_once(path, frames, problems)
    if missing:
        notes.append(MissingPhotos(len(missing), len(frames) + len(missing), missing[0]))
    cloud, no_cloud = _cloud(path, contents)
    if "ply_file_path" in contents and is_outside(
        path.parent, points := _tidy(str(contents["ply_file_path"]))
    ):
        outside.append(path.parent / points)
    if outside:
        notes.append(FilesOutside(outside[0], len(outside), path.parent))
    frames, mask_notes = with_masks(path.parent, frames)
    notes += mask_notes
    return Capture("transforms.json", tuple(frames), cloud, tuple(notes), no_cloud or Capture.no_cloud)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that contains one object.

    Returns:
        The object. null counts as missing, at the top level and in frames.

    Raises:
        DatasetError: the file does not contain an object; a syntax error is located by line and column.
    """
    try:
        contents = parse_json(read_text(path, "utf-8-sig"))
    except json.JSONDecodeError as error:
        raise DatasetError(
            f"{path}, line {error.lineno} column {error.colno}: is not JSON ({error.msg}); repair the file"
        ) from None
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: is not JSON (not UTF-8 text); repair the file") from None
    except ValueError as error:
        raise DatasetError(f"{path}: is not JSON ({error}); repair the file") from None
    if not isinstance(contents, dict) or not isinstance(contents.get("frames"), list):
        raise DatasetError(f"{path}: has no list of frames; expected a transforms.json")
    contents["frames"] = [_stated(f) if isinstance(f, dict) else f for f in contents["frames"]]
    return _stated(contents)


def _stated(values: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if value is not None}


def nothing_found(path: Path, missing: list[str]) -> DatasetError:
    """Return the error for a file in which no frame has a photo."""
    what = (
        f"none of its {len(missing)} photos has a file, first {missing[0]}" if missing else "lists no frames"
    )
    return DatasetError(f"{path}: {what}; put the photos where the file expects them")


def read_frames(path: Path, contents: Mapping[str, Any], part: str = "") -> Found:
    """Read the frames of a transforms.json.

    Args:
        path: The file.
        contents: Its contents.
        part: The part of the dataset for all frames; "" uses the file's own lists.

    Raises:
        DatasetError: a frame has no file_path, an unsupported camera model, or an invalid mask or depth map.
    """
    found = Found([], [], [], [])
    parts, listings = _parts(path, contents), Listings()
    shared = {key: value for key, value in contents.items() if key in INTRINSICS}
    moving = {key: value for key, value in contents.items() if key in SHUTTER_KEYS}
    common: Lens | None = None  # shared by all frames without their own intrinsics
    for number, frame in enumerate(contents["frames"]):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise DatasetError(f"{path}, frame {number}: has no file_path; every frame needs one")
        name = _tidy(frame["file_path"])
        image = _photo(path.parent / as_file_name(name), listings)
        if image is None:
            found.missing.append(missing_photo(legible(name), [path.parent / as_file_name(name)]))
            continue
        where = f"{path}, frame {legible(name)}"
        values = _merged(shared, frame)
        fisheye = _is_fisheye(where, values)
        mask, depth = _mask(where, path.parent, frame), _depth(where, path.parent, frame)
        found.outside.extend([image] if is_outside(path.parent, name) else [])
        found.outside.extend(
            [mask] if mask and is_outside(path.parent, _tidy(str(frame["mask_path"]))) else []
        )
        found.outside.extend(
            [depth] if depth and is_outside(path.parent, _tidy(frame["depth_file_path"])) else []
        )
        own = not frame.keys().isdisjoint(INTRINSICS)
        try:
            lens = common if common is not None and not own else _lens(where, values, image, fisheye)
            if not own and {"w", "h"} <= shared.keys():
                common = lens
            R, eye = _pose(where, frame)
            its_part = part or parts.get(name, parts[""])
            given = checked_frame(
                where, Frame(legible(name), image, lens, R, eye, mask, its_part, depth=depth)
            )
            shutter = shutter_from_keys(where, {**moving, **frame}, given.R)
        except DatasetError as error:
            found.problems.append(Problem.of(legible(name), where, error))
            continue
        found.frames.append(replace(given, shutter=shutter))
    return found


def each_once(path: Path, frames: Sequence[Frame], problems: list[Problem]) -> tuple[list[Frame], list[Note]]:
    """Return frames with each photo once, and notes about those that are left out.

    Of several entries of a photo with the same pose and camera, the first counts. Entries that differ are left out,
    because it is unknown which of them is right.

    Args:
        path: The file, for messages.
        frames: The frames as read.
        problems: Photos that cannot be used; those with different entries are added.

    Raises:
        DatasetError: no photo remains.
    """
    entries = dict[str, list[Frame]]()
    for frame in frames:
        entries.setdefault(os.path.normpath(frame.image), []).append(frame)
    once, repeated = list[Frame](), list[str]()
    for first, *others in entries.values():
        if all(_same_camera(first, other) for other in others):
            once.append(first)
            repeated += [first.name] if others else []
        else:
            reason = f"is listed {1 + len(others)} times, with different poses or cameras"
            problems.append(Problem(first.name, f"{path}, frame {first.name}: {reason}", reason))
    total = len(once) + len(problems)
    notes: list[Note] = [RepeatedPhotos(len(repeated), total, repeated[0])] if repeated else []
    return once, notes + problem_notes(problems, total)


def _same_camera(one: Frame, other: Frame) -> bool:
    size = max(1.0, float(np.abs(one.eye).max()))
    near = np.allclose(one.eye, other.eye, rtol=0, atol=SAME_POSE * size)
    return near and np.allclose(one.R, other.R, rtol=0, atol=SAME_POSE) and one.lens == other.lens


def _photo(path: Path, listings: Listings) -> Path | None:
    """Find the photo of a file_path, which may lack its suffix."""
    if not listings.may_hold(str(path)):
        return None
    if (photo := find_photo(path)) is not None:
        return photo
    spelled = (s for ending in PHOTO_ENDINGS for s in (ending, ending.upper(), ending.title()))
    return next((p for end in spelled if (p := find_photo(Path(f"{path}{end}")))), None)


def _tidy(file_path: str) -> str:
    """Normalise a path to POSIX form, without a leading dot."""
    return PurePosixPath(file_path.replace("\\", "/")).as_posix()


def _parts(path: Path, contents: Mapping[str, Any]) -> dict[str, str]:
    """Return the part of each listed name, and under "" the part of all other names."""
    lists = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = contents.get(key, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise DatasetError(f"{path}: {key} is not a list of file paths; repair or remove it")
        lists[key] = [_tidy(name) for name in names]
    held_out = lists["test_filenames"] or lists["val_filenames"]
    parts = {**dict.fromkeys(lists["val_filenames"], "left out"), **dict.fromkeys(held_out, "test")}
    parts.update(dict.fromkeys(lists["train_filenames"], "train"))
    if lists["train_filenames"]:
        return {"": "left out", **parts}
    return {"": "train" if held_out else "", **parts}


def _merged(contents: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """Return a frame's keys, completed with those of the file.

    If the frame gives its own focal length in x, none of the file's focal lengths is used; if it gives only the one in
    y, the file's focal length in x is used.
    """
    axes = "xy" if any(key in frame for key in FOCAL_KEYS["x"]) else "y"
    stated = any(key in frame for axis in axes for key in FOCAL_KEYS[axis])
    dropped = [key for axis in axes for key in FOCAL_KEYS[axis]] if stated else []
    return {**{key: value for key, value in contents.items() if key not in dropped}, **frame}


def _is_fisheye(where: str, values: Mapping[str, Any]) -> bool:
    """Return whether a frame's camera model is a fisheye.

    Raises:
        DatasetError: the model is unsupported.
    """
    model = FISHEYE_MODEL if values.get("is_fisheye") is True else values.get("camera_model", "OPENCV")
    if model not in CAMERA_MODELS:
        raise DatasetError(
            f"{where}: camera_model {model!r} is not supported, only {', '.join(CAMERA_MODELS)}; undistort the "
            "capture first"
        )
    return bool(model == FISHEYE_MODEL)


def _lens(where: str, values: Mapping[str, Any], image: Path, fisheye: bool) -> Lens:
    """Read the intrinsics of one frame."""
    W, H = (
        (_whole(where, values, "w"), _whole(where, values, "h"))
        if "w" in values and "h" in values
        else (0, 0)
    )
    if not W:
        W, H = image_size(image)
    fx, fy = _focal(where, values, "x", W), _focal(where, values, "y", H)
    if fx is None:
        raise DatasetError(f"{where}: neither it nor the file has fl_x or camera_angle_x; add one of them")
    named = {"fx": fx, "fy": fx if fy is None else fy, "cx": W / 2, "cy": H / 2}
    for key in ("cx", "cy", *COEFFICIENTS):
        if key in values:
            named[key] = _number(where, values, key)
    try:
        return lens_of(named, W, H, FISHEYE if fisheye else PINHOLE_LIKE)
    except DatasetError as error:
        raise DatasetError(f"{where}: {error}") from None


def _focal(where: str, values: Mapping[str, Any], axis: str, size: int) -> float | None:
    """Read a focal length, px, or convert a field of view: f = size / (2 tan(angle / 2))."""
    length, key = FOCAL_KEYS[axis]
    if length in values:
        return _number(where, values, length)
    if key not in values:
        return None
    angle = _number(where, values, key)
    if not 0.0 < angle < math.pi:
        raise DatasetError(f"{where}: {key} is {angle:g}, but must be between 0 and pi radians")
    return 0.5 * size / math.tan(0.5 * angle)


def _number(where: str, values: Mapping[str, Any], key: str) -> float:
    value = values[key]
    try:
        number = float("nan") if isinstance(value, bool | str) else float(value)
    except (TypeError, OverflowError):
        number = float("nan")
    if not math.isfinite(number):
        raise DatasetError(f"{where}: {key} is {str(value)[:40]}, but must be a number")
    return number


def _whole(where: str, values: Mapping[str, Any], key: str) -> int:
    number = _number(where, values, key)
    if number != round(number) or number < 1:
        raise DatasetError(f"{where}: {key} is {number:g}, but must be a size in pixels")
    return int(number)


def _pose(
    where: str, frame: Mapping[str, Any]
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Convert a camera-to-world matrix in OpenGL axes to a world-to-camera rotation in OpenCV axes, and the centre."""
    if "transform_matrix" not in frame:
        raise DatasetError(f"{where}: has no transform_matrix; every frame needs its pose")
    matrix = _matrix(where, frame, "transform_matrix")
    return (matrix[:3, :3] * np.array([1.0, -1.0, -1.0])).T, matrix[:3, 3].copy()


def _matrix(where: str, values: Mapping[str, Any], key: str) -> Float64[np.ndarray, "rows 4"]:
    try:
        matrix = np.array(values[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise DatasetError(f"{where}: {key} is not a 3x4 or 4x4 matrix; repair it")
    if matrix.shape == (4, 4) and not np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() <= 1e-6:
        raise DatasetError(f"{where}: the last row of {key} is {matrix[3].tolist()}, but must be 0 0 0 1")
    return matrix


def _mask(where: str, folder: Path, frame: Mapping[str, Any]) -> Path | None:
    if "mask_path" not in frame:
        return None
    mask = folder / as_file_name(_tidy(str(frame["mask_path"])))
    if not is_file(mask):
        raise DatasetError(f"{where}: its mask {mask} does not exist; add it or remove mask_path")
    return mask


def _depth(where: str, folder: Path, frame: Mapping[str, Any]) -> Path | None:
    """Return the file of a frame's depth map, which is read only if the training asks for depth."""
    named = frame.get("depth_file_path")
    if named is None:
        return None
    if not isinstance(named, str):
        raise DatasetError(
            f"{where}: depth_file_path is {str(named)[:40]}, but must be a path; repair or remove it"
        )
    return folder / as_file_name(_tidy(named))


def _cloud(path: Path, contents: Mapping[str, Any]) -> tuple[Cloud | None, str]:
    """Read the initial cloud: the PLY that the file names, else the points of the COLMAP model behind the poses.

    The PLY already has the poses' coordinate frame. COLMAP's points precede `applied_transform`, which is applied to
    them here. Without that key, or if the poses were scaled too, the relation between the two frames is unknown.

    Returns:
        The points; or None, and the reason if COLMAP's points exist but cannot be used.
    """
    if "ply_file_path" in contents:
        return read_points_ply(path.parent / as_file_name(_tidy(str(contents["ply_file_path"])))), ""
    model = find_model(path.parent)
    if model is None or points_file(model) is None:
        return None, ""
    unused = f"the points of the COLMAP model in {model} are not used, because {path.name}"
    if "applied_transform" not in contents:
        return None, f"{unused} does not give applied_transform, the motion of its poses"
    scale = _number(str(path), contents, "applied_scale") if "applied_scale" in contents else 1.0
    if scale != 1.0:
        return None, f"{unused} has poses scaled by {scale:g} (applied_scale)"
    matrix = _matrix(str(path), contents, "applied_transform")
    if not np.all(np.isfinite(matrix)):
        raise DatasetError(f"{path}: applied_transform is NaN or infinite; repair or remove it")
    cloud = read_points(model)
    if cloud is None:
        return None, ""
    return Cloud(cloud.points @ matrix[:3, :3].T + matrix[:3, 3], cloud.colors), ""

"""COLMAP's sparse models: cameras, images and points3D, as .bin or .txt.

World and camera axes match this project's. Quaternions are (w, x, y, z) and rotate world into camera coordinates, x_cam
= R x + t, so the camera centre is -R' t. The contents of rigs.bin and frames.bin of newer versions are also in
images.bin, so those files are not read.

Source: COLMAP's documentation, "Output Format" and "Camera Models".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import (
    Capture,
    Cloud,
    Frame,
    Listings,
    Problem,
    checked_frame,
    entries,
    faces_of,
    find_photo,
    is_file,
    is_folder,
    is_outside,
    missing_photo,
    problem_notes,
    unit_colors,
)
from gsplat_edu.data.colmap_files import (
    MODELS,
    Pose,
    cameras_bin,
    cameras_txt,
    count_bin,
    images_bin,
    images_txt,
    points_bin,
    points_txt,
)
from gsplat_edu.data.lens import FISHEYE, PINHOLE_LIKE, Lens, lens_of
from gsplat_edu.data.masks import MASKS, find_named
from gsplat_edu.data.notes import FilesOutside, MissingPhotos, Note, OtherModels
from gsplat_edu.data.panorama import FaceLens
from gsplat_edu.scene.gaussian_math import quat_to_R

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

LISTS = tuple(f"images{suffix}" for suffix in SUFFIXES)
"""Names of the file in a model that lists its images."""


def find_model(path: Path) -> Path | None:
    """Find the folder of a model, by its cameras or images file; of numbered ones the one with the most images.

    A mapper writes a numbered model for each group of photos that it could connect. Of equal ones, the first is found.

    Args:
        path: The capture, its folder of models, or the model; or the file in a model that lists its images.
    """
    if is_file(path):
        return path.parent if path.name in LISTS else None
    found = next(iter(_models(path)), None)
    if found is None or found == path or not found.name.isdecimal():
        return found
    beside = [place for place in _numbered(found.parent) if _is_model(place)]
    return found if beside == [found] else max(beside, key=lambda place: _image_count(place) or 0)


def image_lists(folder: Path) -> list[Path]:
    """Return the file that lists the images of each model in a capture.

    Args:
        folder: The capture.
    """
    return [listed for model in _models(folder) if (listed := _image_list(model)) is not None]


def _models(folder: Path) -> list[Path]:
    places = [folder / place for place in PLACES]
    for parent in (folder / "sparse", folder / "colmap" / "sparse", folder):
        places += _numbered(parent)
    return [place for place in dict.fromkeys(places) if _is_model(place)]


def _image_list(model: Path) -> Path | None:
    return next((model / name for name in LISTS if is_file(model / name)), None)


def _is_model(place: Path) -> bool:
    names = [f"{part}{suffix}" for part in ("cameras", "images") for suffix in SUFFIXES]
    return any(is_file(place / name) for name in names)


def read_colmap(folder: Path, model: Path) -> Capture:
    """Read a capture with poses from COLMAP.

    Args:
        folder: The capture, with the photos in images/ or next to the model.
        model: The folder with cameras, images and optionally points3D.

    Images whose pose or camera is NaN, infinite or absurd are left out, and named in a note.

    Raises:
        DatasetError: a file is missing, truncated or malformed; a camera model is unsupported; two images share one
            file; or no image has a file and a usable pose and camera.
    """
    suffix = _suffix(model)
    listed = model / f"images{suffix}"
    poses = read_images(listed)
    if not poses:
        raise DatasetError(f"{listed}: lists no images; run COLMAP's mapper, or choose another model")
    photos, masks, notes = _files(folder, model, [pose.name for pose in poses])
    there = [pose for pose in poses if pose.name in photos]
    folders, _ = _photo_folders(folder, model)
    missing = [
        missing_photo(legible(pose.name), (place / pose.name for place in folders))
        for pose in poses
        if pose.name not in photos
    ]
    if not there:
        raise DatasetError(
            f"{folder}: none of the {len(poses)} photos listed in {listed.name} has a file, first {missing[0]}; put "
            "them into images/"
        )
    frames, problems = _frames(model, suffix, there, photos, masks)
    notes += problem_notes(problems, len(there)) + _other_models(folder, model)
    if missing:
        notes.append(MissingPhotos(len(missing), len(poses), missing[0]))
    return Capture("COLMAP", tuple(frames), read_points(model), tuple(notes))


def _frames(
    model: Path, suffix: str, poses: Sequence[Pose], photos: Mapping[str, Path], masks: Mapping[str, Path]
) -> tuple[list[Frame], list[Problem]]:
    """Return the frames of the images that have photos, and what is wrong with the others."""
    lenses = _lenses(model / f"cameras{suffix}", {pose.camera for pose in poses})
    frames, problems = list[Frame](), list[Problem]()
    for pose in poses:
        name = legible(pose.name)
        where = f"{model / f'images{suffix}'}, image {name}"
        if pose.camera not in lenses:
            raise DatasetError(
                f"{where}: its camera {pose.camera} is not in cameras{suffix}; the two files do not belong together"
            )
        try:
            lens = lenses[pose.camera]
            if isinstance(lens, DatasetError):
                raise lens
            R, eye = _placed(where, pose)
            frame = Frame(name, photos[pose.name], lens, R, eye, masks.get(pose.name))
            frames += faces_of(checked_frame(where, frame))
        except DatasetError as error:
            problems.append(Problem.of(name, where, error))
    return frames, problems


def _other_models(folder: Path, model: Path) -> list[Note]:
    """Report the models beside the one that is read."""
    others = [place for place in _numbered(model.parent) if place != model]
    if not (model.name.isdecimal() and others and (model.parent == folder or model.parent.name == "sparse")):
        return []
    counts = tuple((place.name, _image_count(place)) for place in others)
    return [OtherModels(model.parent, model.name, _image_count(model), counts)]


def _image_count(model: Path) -> int | None:
    """Return the number of images that a model lists; None if it cannot be read."""
    try:
        path = model / f"images{_suffix(model)}"
        return count_bin(path) if path.suffix == ".bin" else len(images_txt(path))
    except DatasetError:
        return None


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
    points, colors = points_bin(path) if path.suffix == ".bin" else points_txt(path)
    return Cloud(points, unit_colors(colors / 255.0)) if len(points) else None


def read_cameras(path: Path, used: Container[int] | None = None) -> dict[int, Lens]:
    """Read the lenses of a model, by camera number.

    Args:
        path: cameras.bin or cameras.txt.
        used: Numbers of the required cameras; None for all. Other cameras may be unsupported.

    Raises:
        DatasetError: the file is truncated or malformed, or a required camera is unsupported or invalid.
    """
    lenses = {}
    for camera, lens in _lenses(path, used).items():
        if isinstance(lens, DatasetError):
            raise lens
        lenses[camera] = lens
    return lenses


def _lenses(path: Path, used: Container[int] | None) -> dict[int, Lens | DatasetError]:
    """Read the lenses of a model; the error of a required camera whose numbers are no camera takes its place."""
    lenses: dict[int, Lens | DatasetError] = {}
    for where, camera, model, W, H, values in (
        cameras_bin(path) if path.suffix == ".bin" else cameras_txt(path)
    ):
        if used is not None and camera not in used:
            continue
        try:
            named = _parameters(model, values)
        except DatasetError as error:
            raise DatasetError(f"{where}: {error}") from None
        try:
            lenses[camera] = _lens(model, W, H, named)
        except DatasetError as error:
            lenses[camera] = DatasetError(f"{where}: {error}", f"camera {camera}: {error}")
    return lenses


def read_images(path: Path) -> list[Pose]:
    """Read names and poses, in the order of the file.

    Args:
        path: images.bin or images.txt.

    Raises:
        DatasetError: the file is truncated or malformed.
    """
    return images_bin(path) if path.suffix == ".bin" else images_txt(path)


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
    photos, masks = [folder / "images", folder], [folder / MASKS]
    if model == folder or (model.parent == folder and model.name.isdecimal()):
        # The model or its parent folder was given; its photos are where they would be for the capture.
        above = folder.absolute().parents[:2]
        photos += [parent / "images" for parent in above]
        masks += [parent / MASKS for parent in above]
    return photos, masks


def _files(
    folder: Path, model: Path, names: Sequence[str]
) -> tuple[dict[str, Path], dict[str, Path], list[Note]]:
    """Find photos and masks by the names of the images, and report unused files.

    A file outside the folders of its image's name is used if no other image has the same bare name.

    Raises:
        DatasetError: two images share one file, two masks fit one image, or there are masks and none fits.
    """
    photo_folders, mask_folders = _photo_folders(folder, model)
    listings = Listings()
    bare = Counter(Path(name).name for name in names)
    photos = dict[str, Path]()
    for name in names:
        last = Path(name).name
        alone = [last] if bare[last] == 1 else []
        places = [p for p in _candidates(photo_folders, name, alone) if listings.may_hold(str(p))]
        # Photos of full size first, in any folder; then those of images_2, images_4 and images_8.
        photo = next((p for find in (_present, find_photo) for p in map(find, places) if p), None)
        if photo is not None:
            photos[name] = photo
    _check_single(model, names, photos)
    masks, mask_notes = find_named(mask_folders, names)
    _check_single(model, names, masks)
    notes = list[Note]()
    outside = [photos[name] for name in names if name in photos and is_outside(folder, name)]
    if outside:
        notes.append(FilesOutside(outside[0], len(outside), folder))
    return photos, masks, [*notes, *mask_notes]


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


def _placed(where: str, pose: Pose) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    shift = np.array(pose.shift)
    if not np.all(np.abs(shift) < 1e100):  # the rest is checked by checked_frame
        raise DatasetError(f"{where}: its pose is NaN or infinite")
    if not np.all(np.isfinite(pose.quat)) or not np.any(pose.quat):
        raise DatasetError(f"{where}: its quaternion {pose.quat} is not a rotation")
    R = quat_to_R(pose.quat)
    return R, -R.T @ shift


def _parameters(model: str, values: Sequence[float]) -> dict[str, float]:
    """Return the parameters of a camera by name."""
    names = dict(MODELS).get(model, "").split()
    if not names:
        raise DatasetError(
            f"camera model {model} is not supported; run `colmap image_undistorter` and load its output"
        )
    if len(values) != len(names):
        raise DatasetError(f"{model} has {len(names)} parameters ({', '.join(names)}), got {len(values)}")
    return dict(zip(names, values, strict=True))


def _lens(model: str, W: int, H: int, named: dict[str, float]) -> Lens:
    if model == SPHERE:
        return FaceLens.of(W, H, 0)
    if "f" in named:
        named["fx"] = named["fy"] = named.pop("f")
    plain = FISHEYE if model.endswith("FISHEYE") else PINHOLE_LIKE
    return lens_of(named, W, H, FORMULA_OF.get(model, plain))

"""Other programs whose poses are read, and captures with such poses."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import (
    POSE_PLACES,
    Capture,
    Frame,
    Problem,
    capture_folder,
    checked_frame,
    entries,
    faces_of,
    is_file,
    is_folder,
    problem_notes,
)
from gsplat_edu.data.masks import with_masks
from gsplat_edu.data.notes import MissingPhotos, OtherPoses, PosesOf
from gsplat_edu.data.readers.bundler import BUNDLER
from gsplat_edu.data.readers.llff import LLFF
from gsplat_edu.data.readers.meshroom import MESHROOM
from gsplat_edu.data.readers.metashape import METASHAPE
from gsplat_edu.data.readers.nvm import VISUALSFM
from gsplat_edu.data.readers.openmvg import OPENMVG
from gsplat_edu.data.readers.opensfm import OPENSFM
from gsplat_edu.data.readers.opf import OPF
from gsplat_edu.data.readers.photo_names import PhotoNames
from gsplat_edu.data.readers.polycam import POLYCAM
from gsplat_edu.data.readers.pose_file import PoseProgram, Poses, head_of
from gsplat_edu.data.readers.realitycapture import TABLE, XMP
from gsplat_edu.data.readers.record3d import RECORD3D
from gsplat_edu.data.readers.rgbd import SCANNET, SEVEN_SCENES
from gsplat_edu.data.readers.tum import TUM
from gsplat_edu.data.scale import Scale, read_scale

PROGRAMS = (
    *(OPENSFM, METASHAPE, TABLE, XMP, OPENMVG, MESHROOM, OPF, BUNDLER, VISUALSFM, LLFF),
    *(POLYCAM, RECORD3D, SEVEN_SCENES, SCANNET, TUM),
)
"""In the order in which they are preferred, if their files have equally many photos."""

PLACES = (".", "images", *POSE_PLACES)
"""Folders of a capture that are searched for pose files."""

SUFFIXES = (".json", ".xml", ".csv", ".xmp", ".out", ".nvm", ".npy", ".sfm", ".txt", ".r3d", "")
"""Suffixes of pose files, in lower case; other files are not opened. Record3D's metadata has none."""


class Found(NamedTuple):
    """A pose file and the program that wrote it."""

    program: PoseProgram
    path: Path


def pose_files(path: Path) -> list[Found]:
    """Find the pose files of other programs.

    Args:
        path: A capture's folder, or a pose file.
    """
    if path.suffix.lower() in SUFFIXES and is_file(path):
        return _recognized(path)
    found = list[Found]()
    for place in (path / name for name in PLACES):
        if not is_folder(place):
            continue
        once = set[PoseProgram]()
        for file in entries(place):
            if file.suffix.lower() not in SUFFIXES or not is_file(file):
                continue
            new = [each for each in _recognized(file) if each.program not in once]
            once.update(each.program for each in new if each.program.together)
            found += new
    return found


def _recognized(path: Path) -> list[Found]:
    head = head_of(path)
    return [Found(program, path) for program in PROGRAMS if program.holds(path, head)][:1]


def read_poses(path: Path, files: list[Found]) -> Capture:
    """Read a capture with the poses of another program: of several files the one that poses the most of its photos.

    Args:
        path: The capture's folder, or the pose file in it.
        files: What `pose_files` found; at least one.

    Raises:
        DatasetError: no file can be used; the message is that of the first.
    """
    folder = capture_folder(path)
    photos = PhotoNames(folder)
    captures, errors = list[tuple[int, Found, Capture]](), list[tuple[Found, DatasetError]]()
    for each in files:
        try:
            posed, capture = _capture(folder, photos, each.program, each.program.read(each.path))
        except DatasetError as error:
            errors.append((each, error))
        else:
            captures.append((posed, each, capture))
    if not captures:
        raise errors[0][1]
    most, best, capture = max(captures, key=lambda each: each[0])
    unused = [(file.path, f"{posed} photos") for posed, file, _ in captures if file is not best]
    unused += [(file.path, error.reason.removeprefix(f"{file.path}: ")) for file, error in errors]
    said = (PosesOf(most, len(photos.paths), best.program.name),)
    others = (OtherPoses(best.path, most, tuple(unused)),) if unused else ()
    return Capture(
        capture.layout,
        capture.frames,
        capture.cloud,
        (*said, *others, *capture.notes),
        scale=read_scale(folder) or capture.scale,
    )


def _capture(folder: Path, photos: PhotoNames, program: PoseProgram, poses: Poses) -> tuple[int, Capture]:
    """Return the number of photos with a usable pose, and the capture."""
    frames, missing, owners, posed = list[Frame](), list[str](), dict[str, str](), 0
    problems = [
        Problem(name, f"{poses.path}, photo {legible(name)}: {reason}", reason)
        for name, reason in poses.without
    ]
    for shot in poses.shots:
        name = legible(shot.name)
        where = f"{poses.path}, photo {name}"
        found = photos.find(str(poses.path), shot.name)
        if found is None:
            missing.append(name)
            continue
        if (other := owners.setdefault(found, name)) != name:
            raise DatasetError(
                f"{poses.path}: {other} and {name} would both be the photo {legible(found)}; put all photos into "
                f"{folder}"
            )
        try:
            image = photos.paths[found]
            frame = Frame(legible(found.removeprefix("images/")), image, shot.lens(image), shot.R, shot.eye)
            frames += faces_of(checked_frame(where, frame))
            posed += 1
        except DatasetError as error:
            message = str(error) if str(error).startswith(where) else f"{where}: {error}"
            problems.append(Problem(name, message, error.reason.removeprefix(f"{where}: ")))
    if not frames and not problems:
        what = (
            f"none of its {len(missing)} photos is in {folder}, first {missing[0]}"
            if missing
            else "has no photo"
        )
        raise DatasetError(f"{poses.path}: {what}; put the photos beside it or into images/")
    try:
        notes = [*poses.notes, *problem_notes(problems, len(problems) + posed)]
    except DatasetError as error:
        raise DatasetError(str(error), problems[0].reason) from None
    if missing:
        notes.append(MissingPhotos(len(missing), len(missing) + len(problems) + posed, missing[0]))
    frames, mask_notes = with_masks(folder, frames)
    scale = (
        None if poses.earth is None else Scale("m", f"the georeference of {program.name}", earth=poses.earth)
    )
    return posed, Capture(program.name, tuple(frames), poses.cloud, (*notes, *mask_notes), scale=scale)

"""Whose poses a capture is read with, where several programs left some: the file chosen_poses.txt in its folder.

It holds the path of one file with poses, below the capture's folder. Without it, `gsplat_edu.data.reader.read_capture`
says which poses are read; a file with poses that is given on the command line (`--poses`) is read instead of both.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import unreadable, written_aside
from gsplat_edu.base.reading import read_text
from gsplat_edu.data.blender import TRAIN_FILE
from gsplat_edu.data.capture import is_file, is_folder
from gsplat_edu.data.colmap import image_lists
from gsplat_edu.data.readers.programs import pose_files

CHOSEN = "chosen_poses.txt"
"""Name of the file."""

TRANSFORMS = "transforms.json"
"""A file with poses that belongs to no other program."""

COLMAP = "COLMAP"
"""The program whose model is chosen by the file that lists its images."""


class PoseChoice(NamedTuple):
    """A file whose poses a capture can be read with.

    Args:
        file: Its path below the capture's folder, with slashes.
        program: Name of the program that wrote it.
    """

    file: str
    program: str


def pose_choices(capture: Path) -> list[PoseChoice]:
    """Return the files that a capture's poses can be read from, in the order in which they are looked for.

    Args:
        capture: The capture's folder.
    """
    files = [(capture / TRAIN_FILE, "Blender"), (capture / TRANSFORMS, TRANSFORMS)]
    files = [(path, program) for path, program in files if is_file(path)]
    files += [(path, COLMAP) for path in image_lists(capture)]
    files += [(found.path, found.program.name) for found in pose_files(capture)]
    return [PoseChoice(path.relative_to(capture).as_posix(), program) for path, program in files]


def chosen_poses(capture: Path) -> Path:
    """Return the file with poses that was chosen for a capture; its path as it is without a choice, or for a file.

    Args:
        capture: The capture's folder, or its file with poses.

    Raises:
        DatasetError: the choice cannot be read, or names no file with poses of this capture.
    """
    path = capture / CHOSEN
    if not (is_folder(capture) and is_file(path)):
        return capture
    try:
        name = read_text(path, "utf-8-sig").strip()
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: is not text in UTF-8; choose again, or delete the file") from None
    if name not in {choice.file for choice in pose_choices(capture)}:
        raise DatasetError(
            f"{path}: {name[:80]!r} is no file with poses in {capture}; choose again, or delete the file"
        )
    return capture / name


def choose_poses(capture: Path, file: str | None) -> None:
    """Choose whose poses a capture is read with.

    Args:
        capture: The capture's folder.
        file: One of `pose_choices`; None to take the choice back.

    Raises:
        DatasetError: it is none of them.
        OSError: the folder cannot be written to.
    """
    path = capture / CHOSEN
    if file is None:
        path.unlink(missing_ok=True)
        return
    if file not in {choice.file for choice in pose_choices(capture)}:
        raise DatasetError(f"{capture}: {file[:80]!r} is no file with poses; choose another one")
    with written_aside(path) as aside:
        aside.write_text(file + "\n", encoding="utf-8")

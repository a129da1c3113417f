"""Camera-to-world matrices, a text file for each photo: 7-Scenes and ScanNet. Axes are OpenCV's, lengths metres.

7-Scenes has frame-N.pose.txt beside frame-N.color.png. Its lens is the data set's: `FOCAL` px for both axes, with the
principal point in the middle of 640x480. ScanNet has pose/N.txt, color/N.jpg and intrinsic/intrinsic_color.txt, whose
4x4 matrix has fx, fy, cx and cy in px; a pose that the scanner lost is -inf.

Source: the data sets' pages, "RGB-D Dataset 7-Scenes" (Microsoft Research) and ScanNet's SensReader.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import entries, is_file
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.readers.pose_file import PoseProgram, Poses, Shot, numbers_of, sized, text_of
from gsplat_edu.photos.decoding import image_size

FOCAL = 585.0
"""Focal length of 7-Scenes, px at `SIZE`."""

SIZE = (640, 480)
"""Photos of 7-Scenes, px."""

SCENES = ".pose.txt"

POSE, INTRINSIC = "pose", "intrinsic/intrinsic_color.txt"

LOST = "-inf"


def holds_scenes(path: Path, head: bytes) -> bool:
    """Return whether a file is a pose of 7-Scenes."""
    return path.name.lower().endswith(SCENES) and len(head.split()) == 16


def read_scenes(path: Path) -> Poses:
    """Read the poses of 7-Scenes in the folder of one of them.

    Raises:
        DatasetError: one of them is damaged.
    """
    files = [each for each in entries(path.parent) if each.name.lower().endswith(SCENES) and is_file(each)]
    values = {"fx": FOCAL, "fy": FOCAL, "cx": 0.0, "cy": 0.0}
    shots = []
    for each in files:
        pose = _matrix(each, text_of(each))
        name = f"{each.name[: -len(SCENES)]}.color.png"
        shots.append(Shot(name, pose[:3, :3].T, pose[:3, 3], sized(values, SIZE)))
    return Poses(path.parent, shots)


def holds_scannet(path: Path, head: bytes) -> bool:
    """Return whether a file is a pose of ScanNet."""
    return path.parent.name == POSE and path.suffix.lower() == ".txt" and len(head.split()) == 16


def read_scannet(path: Path) -> Poses:
    """Read the poses of ScanNet in the folder of one of them, and their lens.

    Raises:
        DatasetError: a file is damaged, or the lens is missing.
    """
    folder = path.parent
    file = folder.parent / INTRINSIC
    if not is_file(file):
        raise DatasetError(f"{folder}: lacks the lens of its photos; put {INTRINSIC} into {folder.parent}")
    K = _matrix(file, text_of(file))

    def lens(photo: Path) -> Lens:
        W, H = image_size(photo)
        values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] - W / 2, "cy": K[1, 2] - H / 2}
        return sized({name: float(value) for name, value in values.items()}, (W, H))(photo)

    shots, without = list[Shot](), list[tuple[str, str]]()
    for each in entries(folder):
        if each.suffix.lower() != ".txt" or not is_file(each):
            continue
        text, name = text_of(each), f"color/{each.stem}.jpg"
        if LOST in text.lower().split():
            without.append((name, "the scanner had lost its pose"))
            continue
        pose = _matrix(each, text)
        shots.append(Shot(name, pose[:3, :3].T, pose[:3, 3], lens))
    return Poses(folder, shots, without=tuple(without))


def _matrix(path: Path, text: str) -> Float64[np.ndarray, "4 4"]:
    return numbers_of(str(path), text, 16).reshape(4, 4)


SEVEN_SCENES = PoseProgram("7-Scenes", holds_scenes, read_scenes, together=True)
SCANNET = PoseProgram("ScanNet", holds_scannet, read_scannet, together=True)

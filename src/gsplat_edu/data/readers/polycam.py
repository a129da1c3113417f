"""Polycam's raw data: a JSON file for each photo, in keyframes/corrected_cameras or keyframes/cameras.

t_00 to t_23 are the rows of the camera-to-world pose, in metres, of cameras that look along -z, with +y up, in a world
with +y up. fx, fy, cx and cy are in px, from the photo's corner. The photo has the file's name, in corrected_images
or images.

Source: Polycam's repository polyform, README and capture_folder.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsplat_edu.base.records import Number
from gsplat_edu.data.capture import entries, is_file
from gsplat_edu.data.readers.bundler import OPENGL
from gsplat_edu.data.readers.pose_file import Foreign, PoseProgram, Poses, Shot, Size, head_of, json_of, sized

IMAGES = {"corrected_cameras": "corrected_images", "cameras": "images"}
"""Folder of the photos of each folder of cameras."""


class KeyframeEntry(Foreign, frozen=True):
    """A pose and a lens."""

    fx: Number
    fy: Number
    cx: Number
    cy: Number
    width: Size
    height: Size
    t_00: Number
    t_01: Number
    t_02: Number
    t_03: Number
    t_10: Number
    t_11: Number
    t_12: Number
    t_13: Number
    t_20: Number
    t_21: Number
    t_22: Number
    t_23: Number


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is that of a photo."""
    return path.suffix.lower() == ".json" and path.parent.name in IMAGES and b'"t_00"' in head


def read(path: Path) -> Poses:
    """Read all files in the folder of one of them.

    Raises:
        DatasetError: one of them is damaged.
    """
    files = [each for each in entries(path.parent) if each.suffix.lower() == ".json" and is_file(each)]
    return Poses(path.parent, [_shot(each) for each in files if holds(each, head_of(each))])


def _shot(path: Path) -> Shot:
    camera: KeyframeEntry = json_of(path, KeyframeEntry)
    pose = np.array([[getattr(camera, f"t_{row}{column}") for column in range(4)] for row in range(3)])
    W, H = camera.width, camera.height
    values = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx - W / 2, "cy": camera.cy - H / 2}
    name = f"{path.parent.parent.name}/{IMAGES[path.parent.name]}/{path.stem}.jpg"
    return Shot(name, OPENGL @ pose[:, :3].T, pose[:, 3], sized(values, (W, H)))


POLYCAM = PoseProgram("Polycam", holds, read, together=True)

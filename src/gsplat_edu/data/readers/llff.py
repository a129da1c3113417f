"""LLFF's poses_bounds.npy.

Each row of 17 numbers is a 3x5 matrix by rows and two depths. Its columns are the camera's down, right and backward
axes and its centre in world coordinates, and (height, width, focal length) of the photos in full size, px. Rows belong
to the photos of images/ in the order of their names.

Source: the README of Mildenhall et al. 2019, "Local Light Field Fusion", section "Using your own poses".
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import unreadable
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.data.capture import PHOTO_ENDINGS, PHOTO_FOLDERS, entries, is_folder
from gsplat_edu.data.lens import MAX_SIDE
from gsplat_edu.data.readers.pose_file import AGAIN, PoseProgram, Poses, Shot, no_lens, sized

NAME = "poses_bounds.npy"

NUMBERS = 17
"""Numbers of a row."""

HEADER = re.compile(
    rb"\x93NUMPY[\x01\x02]\x00(?:..|....)\{'descr': '<f(4|8)', 'fortran_order': (True|False), "
    rb"'shape': \((\d{1,9}), 17\), \} *\n",
    re.DOTALL,
)
"""What `numpy.save` writes before the numbers."""


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is a poses_bounds.npy."""
    return path.name.lower() == NAME and head.startswith(b"\x93NUMPY")


def read(path: Path) -> Poses:
    """Read the poses of the photos in images/.

    Raises:
        DatasetError: the file is damaged, or has not one row for each photo.
    """
    rows = _rows(path)
    folder = path.parent / PHOTO_FOLDERS[0]
    photos = entries(folder) if is_folder(folder) else []
    names = [photo.name for photo in photos if photo.suffix.lower() in PHOTO_ENDINGS]
    if len(names) != len(rows):
        raise DatasetError(
            f"{path}: has {len(rows)} poses, but {folder} {len(names)} photos; put the photos of these poses there"
        )
    shots = []
    for name, row in zip(names, rows, strict=True):
        matrix = row[:15].reshape(3, 5)
        down, right, backward, eye, (H, W, f) = matrix.T
        R = np.stack([right, down, -backward])
        whole = all(1 <= side <= MAX_SIDE and side == round(side) for side in (W, H))
        values = {"fx": float(f), "fy": float(f), "cx": 0.0, "cy": 0.0}
        lens = sized(values, (int(W), int(H))) if whole else no_lens(f"its size {W:g}x{H:g} is no photo's")
        shots.append(Shot(f"{folder.name}/{name}", R, eye, lens))
    return Poses(path, shots)


def _rows(path: Path) -> Float64[np.ndarray, "N 17"]:
    try:
        data = read_bytes(path)
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None
    header = HEADER.match(data)
    if header is None:
        raise DatasetError(f"{path}: is not an array of {NUMBERS} float numbers a row; {AGAIN}")
    size, columns_first, count = int(header[1]), header[2] == b"True", int(header[3])
    if len(data) - header.end() != size * NUMBERS * count:
        raise DatasetError(f"{path}: has not the numbers of {count} rows; copy the whole file")
    numbers = np.frombuffer(data, f"<f{size}", offset=header.end()).astype(np.float64)
    rows = numbers.reshape(NUMBERS, count).T if columns_first else numbers.reshape(count, NUMBERS)
    if not count or not np.all(np.isfinite(rows)):
        raise DatasetError(f"{path}: has {'a number that is not finite' if count else 'no rows'}; {AGAIN}")
    return rows


LLFF = PoseProgram("LLFF", holds, read)

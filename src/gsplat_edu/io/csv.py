"""CSV: a table of splats, for spreadsheets and scripts.

A header row names the columns like the properties of a PLY (`gsplat_edu.io.ply`), in its units: x y z, f_dc_0..2,
f_rest_* channel by channel, opacity (logit), scale_0..2 (logarithms), rot_0..3 as (w, x, y, z). Every further row is a
splat. Numbers are the shortest decimals that give the float32 back, separated by commas; each row ends with a line end.

Columns are read by name, in any order; others are ignored. An infinite logit means an opacity of 0 or 1. There is no
place for metadata, so coordinates that float32 would blur are split into an origin and the rest, as those of a PLY.

Axes are those of the scene: nothing is flipped.

Source: the columns of PlayCanvas' splat-transform (MIT licence).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from jaxtyping import Float64

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import BLOCK, LFS_POINTER, Element, refuse_lfs_pointer
from gsplat_edu.base.reading import open_file
from gsplat_edu.io.ply import (
    LARGEST_LOGIT,
    MEANS,
    OPACITY,
    QUATS,
    SCALES,
    SH0,
    rest_names,
    rows_of,
    splat_vertex,
)
from gsplat_edu.io.scene import Scene, split_origin
from gsplat_edu.scene.gaussians import Gaussians

NORMALS = slice(3, 6)
"""Columns of a PLY that a CSV leaves out."""


def read(path: Path) -> Scene:
    """Read a CSV of splats.

    Args:
        path: The file.

    Returns:
        The scene, float32, in file order, of the file's SH degree. What `write` wrote is restored to the bit.

    Raises:
        SceneFormatError: the file is not a table of splats, or a row is damaged; names the first such row, counted from
            1 after the header.
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        refuse_lfs_pointer(path, file.read(len(LFS_POINTER)))
        file.seek(0)
        lines = TextIOWrapper(file, "utf-8-sig", errors="replace", newline="\n")
        names = [name.strip() for name in next(lines, "").split(",")]
        splat_vertex(path, (Element("vertex", 0, tuple((name, "f4") for name in names)),))
        rest = sum(name.startswith("f_rest_") for name in names)
        columns = [*MEANS, *SH0, *rest_names(rest), *OPACITY, *SCALES, *QUATS]
        blocks = list(_blocks(path, lines, names, columns))
    positions = np.concatenate([np.empty((0, 3)), *(means for means, _ in blocks)])
    values = np.concatenate([np.empty((0, len(columns) - 3), np.float32), *(other for _, other in blocks)])
    ends = np.cumsum([3, rest, 1, 3])
    sh0, sh_rest, opacity, scales, quats = np.split(values, ends, axis=1)
    means, origin = split_origin(positions)
    arrays = (
        means,
        quats,
        scales,
        sh0[:, None],
        np.moveaxis(sh_rest.reshape(len(values), 3, rest // 3), 1, 2),
        opacity[:, 0],
    )
    tensors = (torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)) for array in arrays)
    return Scene(Gaussians(*tensors), origin=origin)


def write(path: Path, scene: Scene) -> None:
    """Write a CSV of splats.

    Args:
        path: Output file; parent folders are created.
        scene: The scene, in this package's axes; written as float32.

    Raises:
        ArgumentError: a parameter is NaN or infinite in float32.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    gaussians = scene.gaussians.map(torch.Tensor.float)
    gaussians.check_finite()
    tensors = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    rest = rest_names(3 * tensors["sh_rest"].shape[1])
    with written_aside(path) as aside, aside.open("w", encoding="ascii", newline="\n") as file:
        file.write(",".join([*MEANS, *SH0, *rest, *OPACITY, *SCALES, *QUATS]) + "\n")
        for start in range(0, len(gaussians), BLOCK):
            rows = rows_of({name: values[start : start + BLOCK] for name, values in tensors.items()})
            texts = np.delete(rows, NORMALS, axis=1).astype(str).tolist()
            file.writelines(",".join(row) + "\n" for row in texts)


def _blocks(
    path: Path, lines: Iterator[str], names: list[str], columns: list[str]
) -> Iterator[tuple[Float64[np.ndarray, "N 3"], np.ndarray]]:
    """Yield the positions in double and the other columns in float32, some rows at a time."""
    places, done = [names.index(name) for name in columns], 0
    opacity = columns.index(OPACITY[0])
    while block := list(islice(lines, BLOCK)):
        for row, line in enumerate(block, done + 1):
            if not line.endswith("\n"):
                _refuse(path, row, "does not end with a line end: the file is truncated")
            if (found := line.count(",") + 1) != len(names):
                _refuse(path, row, f"has {found} columns, but the header has {len(names)}")
        try:
            values = np.loadtxt(block, np.float64, None, ",", usecols=places, ndmin=2)
        except ValueError as error:
            place = re.search(r"string (.*) to float64 at row (\d+), column (\d+)", str(error))
            row, column = (done + 1 + int(place[2]), int(place[3]) - 1) if place else (done + 1, 0)
            _refuse(path, row, f"has no number in column {names[column]}")
        np.copyto(
            values[:, opacity],
            np.copysign(LARGEST_LOGIT, values[:, opacity]),
            where=np.isinf(values[:, opacity]),
        )
        with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite
            rounded = values.astype(np.float32)
        finite = np.isfinite(rounded).all(axis=1)
        if not finite.all():
            _refuse(path, done + 1 + int(finite.argmin()), "has a value that is NaN or infinite")
        yield values[:, : len(MEANS)], rounded[:, len(MEANS) :]
        done += len(block)


def _refuse(path: Path, row: int, fault: str) -> NoReturn:
    raise SceneFormatError(f"{path}: row {row} after the header {fault}; export the scene again")

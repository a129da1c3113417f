"""Initial point clouds: read from a PLY, or random if a capture has none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.constants import C0
from gsplat_edu.base.errors import DatasetError, SceneFormatError
from gsplat_edu.base.ply_table import read_elements, read_rows
from gsplat_edu.base.reading import open_file
from gsplat_edu.data.capture import MAX_COORDINATE, Cloud, unit_colors
from gsplat_edu.data.loading_notes import IgnoredPoints

RANDOM_POINTS = 100_000
"""Size of a random initial cloud, as in Inria's code for Blender scenes."""

BLENDER_CUBE = 1.3
"""Half the edge of the cube that contains a Blender scene, world units, as in the code of Kerbl et al. 2023."""

RGB = ("red", "green", "blue")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")

FULL_SCALE = {"u1": 255.0, "u2": 65535.0}
"""Full brightness of integer colours; 1 for floats."""


Points = Float64[np.ndarray, "N 3"]
"""Positions, world units, or colours, 0 to 1."""


def read_points_ply(path: Path) -> Cloud:
    """Read a point cloud, as `read_ply` does; points without colour become grey.

    Args:
        path: A PLY, ASCII or binary.

    Raises:
        DatasetError: the file is not a point cloud in PLY, or is truncated.
    """
    points, colors = read_ply(path)
    return Cloud(points, grey(points) if colors is None else colors)


def grey(points: Points) -> Points:
    """Return the colours of points that have none."""
    return np.full(points.shape, 0.5)


def read_ply(path: Path) -> tuple[Points, Points | None]:
    """Read a point cloud: x y z, with colours as red green blue or as the f_dc of a Gaussian scene.

    Args:
        path: A PLY, ASCII or binary.

    Returns:
        The points, in the file's units, including NaN and infinity; and their colours, None if there are none.

    Raises:
        DatasetError: the file is not a point cloud in PLY, or is truncated.
    """
    try:
        with open_file(path) as file:
            header = read_elements(path, file)
            vertex = next((e for e in header.elements if {"x", "y", "z"} <= set(e.names)), None)
            if vertex is None:
                raise DatasetError(
                    f"{path}: has no vertices with x, y and z; an initial point cloud needs them"
                )
            table = read_rows(path, file, header, vertex)
    except (OSError, ValueError) as error:  # ValueError: invalid file name
        reason = getattr(error, "strerror", None) or str(error)
        raise DatasetError(f"{path}: cannot be read ({reason}); give a point cloud in PLY format") from None
    except SceneFormatError as error:
        raise DatasetError(str(error)) from None
    with np.errstate(invalid="ignore"):  # converting a signalling NaN raises this flag
        return _columns(table, ("x", "y", "z")), _colors(table, dict(vertex.properties))


def write_points_ply(path: Path, cloud: Cloud) -> None:
    """Write a point cloud as binary PLY: x y z as double, red green blue as uchar.

    Args:
        path: The file.
        cloud: The points; colours are rounded to 8 bits.
    """
    dtype = [*((axis, "<f8") for axis in "xyz"), *((name, "u1") for name in RGB)]
    table = np.zeros(len(cloud.points), dtype)
    for i in range(3):
        table["xyz"[i]] = cloud.points[:, i]
        table[RGB[i]] = np.round(255.0 * np.clip(cloud.colors[:, i], 0.0, 1.0))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {'uchar' if kind == 'u1' else 'double'} {name}" for name, kind in dtype]
    path.write_bytes("\n".join([*header, "end_header", ""]).encode("ascii") + table.tobytes())


def finite_cloud(cloud: Cloud) -> tuple[Cloud, IgnoredPoints | None]:
    """Remove points that are NaN, infinite or absurdly far away.

    Returns:
        The remaining points, and the number removed; None if none was.
    """
    good = np.all(np.abs(cloud.points) < MAX_COORDINATE, axis=1)
    if good.all():
        return cloud, None
    note = IgnoredPoints(int(np.count_nonzero(~good)), len(good))
    return Cloud(cloud.points[good], cloud.colors[good]), note


def random_cloud(centre: Float64[np.ndarray, "3"], half_edge: float) -> Cloud:
    """Draw points and colours uniformly from a cube; every run draws the same ones.

    Args:
        centre: (3,) centre of the cube, world units.
        half_edge: Half the length of its edge, world units.
    """
    rng = np.random.default_rng(0)
    points = centre + half_edge * rng.uniform(-1.0, 1.0, (RANDOM_POINTS, 3))
    return Cloud(points, rng.uniform(0.0, 1.0, (RANDOM_POINTS, 3)))


def _columns(table: np.ndarray, names: Sequence[str]) -> Float64[np.ndarray, "N c"]:
    return np.stack([table[name].astype(np.float64) for name in names], axis=1)


def _colors(table: np.ndarray, kinds: Mapping[str, str | None]) -> Points | None:
    """Return colours from 0 to 1, or None. `kinds` are the file's property types, which ASCII rows have lost."""
    if set(RGB) <= kinds.keys():
        return unit_colors(_columns(table, RGB) / [FULL_SCALE.get(kinds[name] or "", 1.0) for name in RGB])
    if set(SH0) <= kinds.keys():
        return unit_colors(0.5 + C0 * _columns(table, SH0))
    return None

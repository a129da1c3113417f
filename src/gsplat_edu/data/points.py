"""Start clouds: read from a point-cloud PLY, or drawn at random where a capture has none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsplat_edu.camera import Camera
from gsplat_edu.constants import C0
from gsplat_edu.data.capture import MAX_COORDINATE, Cloud
from gsplat_edu.errors import DatasetError

RANDOM_POINTS = 100_000
"""Points of a random start cloud, the number Inria's code draws for Blender scenes."""

BLENDER_CUBE = 1.3
"""Half the edge of the cube that holds a Blender scene, world units: that of Kerbl et al. 2023's code."""

PARALLEL = 1e-4
"""Smallest mean squared sine between optical axes at which they are said to meet: about half a degree."""

TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
"""PLY's names of number types, old and new, as NumPy's."""

RGB = ("red", "green", "blue")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")

FULL_SCALE = {"u1": 255.0, "u2": 65535.0}
"""What full brightness is in an integer colour; that of a float is 1."""

_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 20


def read_points_ply(path: Path) -> Cloud:
    """Read a point cloud: x y z, and colours as red green blue or as the f_dc of a scene of Gaussians.

    Args:
        path: A PLY, ASCII or binary, whose first element is the vertices. Points without colour become gray.

    Returns:
        The points, in the file's units, NaN and infinity included.

    Raises:
        DatasetError: the file is not that, or is cut short; the message names the file, and the line of ASCII.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror}); name a point cloud in PLY") from None
    order, count, dtype, start = _header(path, data)
    if order == "=":
        table = _ascii(path, data, start, count, dtype)
    else:
        if count * dtype.itemsize > len(data) - start:
            raise DatasetError(f"{path}: is cut short; its header says {count} points")
        table = np.frombuffer(data, dtype, count, start)
    with np.errstate(invalid="ignore"):  # a signalling NaN says so when it is converted
        points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
        return Cloud(points, _colors(table))


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


def finite_cloud(cloud: Cloud) -> tuple[Cloud, str]:
    """Leave out points that are NaN, infinite or absurdly far.

    Returns:
        The others, and a sentence that says how many there were; "" where there were none.
    """
    good = np.all(np.abs(cloud.points) < MAX_COORDINATE, axis=1)
    if good.all():
        return cloud, ""
    note = f"{np.count_nonzero(~good)} of {len(good)} points are NaN, infinite or absurdly far: left out"
    return Cloud(cloud.points[good], cloud.colors[good]), note


def random_cloud(centre: Float64[np.ndarray, "3"], half_edge: float) -> Cloud:
    """Draw points and colours evenly from a cube, the same in every run.

    Args:
        centre: (3,) centre of the cube, world units.
        half_edge: Half the length of its edge, world units.
    """
    rng = np.random.default_rng(0)
    points = centre + half_edge * rng.uniform(-1.0, 1.0, (RANDOM_POINTS, 3))
    return Cloud(points, rng.uniform(0.0, 1.0, (RANDOM_POINTS, 3)))


def common_target(cameras: Sequence[Camera]) -> Float64[np.ndarray, "3"]:
    """Find the point closest to all optical axes, in the least-squares sense.

    p minimises sum_i |(I - d_i d_i') (p - e_i)|²,  e_i: centre of camera i,  d_i: direction it looks in

    Args:
        cameras: At least one.

    Returns:
        (3,) world units; the mean of the camera centres where the axes are all but parallel.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    axes = np.stack([camera.R[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    A, mean = across.mean(axis=0), eyes.mean(axis=0)
    if np.linalg.eigvalsh(A)[0] < PARALLEL:
        return np.asarray(mean)
    b = (across @ (eyes - mean)[:, :, None]).mean(axis=0)[:, 0]
    return np.asarray(mean + np.linalg.solve(A, b))


def _header(path: Path, data: bytes) -> tuple[str, int, np.dtype[np.void], int]:
    """Read byte order, number of vertices, their layout, and where the header ends."""
    if data.startswith(b"version https://git-lfs"):
        raise DatasetError(f"{path}: is a Git LFS pointer, not the file itself; fetch it with `git lfs pull`")
    end = data.find(b"end_header", 0, _MAX_HEADER)
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise DatasetError(f"{path}: is not a PLY file; a start cloud has to be one")
    order, count, fields = "", -1, list[tuple[str, str]]()
    for number, line in enumerate(data[:end].decode("ascii", "replace").splitlines(), 1):
        match line.split():
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", "vertex", amount] if amount.isdecimal() and len(amount) < 19 and count < 0:
                count = int(amount)
            case ["element", *_] if count >= 0:
                break
            case ["property", kind, name] if kind in TYPES and count >= 0 and name not in dict(fields):
                fields.append((name, TYPES[kind]))
            case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise DatasetError(
                    f"{path}, line {number}: cannot read {line.strip()[:60]!r}; a start cloud begins with vertices of "
                    "plain numbers"
                )
    if not order or count < 0 or not {"x", "y", "z"} <= dict(fields).keys():
        raise DatasetError(f"{path}: has no vertices with x, y and z; a start cloud needs them")
    return order, count, np.dtype([(name, order + kind) for name, kind in fields]), newline + 1


def _ascii(path: Path, data: bytes, start: int, count: int, dtype: np.dtype[np.void]) -> np.ndarray:
    lines = data[start:].decode("ascii", "replace").splitlines()
    if len(lines) < count:
        raise DatasetError(f"{path}: is cut short; its header says {count} points")
    names = dtype.names or ()
    table = np.zeros((count, len(names)))
    for i in range(count):
        try:
            table[i] = [float(word) for word in lines[i].split()]
        except ValueError:
            number = data[:start].count(b"\n") + i + 1
            raise DatasetError(
                f"{path}, line {number}: is not {len(names)} numbers; export the file again"
            ) from None
    rows = np.zeros(count, [(name, "f8") for name in names])
    for column, name in enumerate(names):
        scale = FULL_SCALE.get(dtype[name].str[1:], 1.0) if name in RGB else 1.0
        rows[name] = table[:, column] / scale
    return rows


def _colors(table: np.ndarray) -> Float64[np.ndarray, "N 3"]:
    """Return colours from 0 to 1."""
    for names in (RGB, SH0):
        if set(names) <= set(table.dtype.names or ()):
            columns = np.stack([table[name].astype(np.float64) for name in names], axis=1)
            if names == SH0:
                columns = 0.5 + C0 * columns
            else:
                columns /= FULL_SCALE.get(table.dtype[names[0]].str[1:], 1.0)
            return np.clip(np.nan_to_num(columns, nan=0.5), 0.0, 1.0)
    return np.full((len(table), 3), 0.5)

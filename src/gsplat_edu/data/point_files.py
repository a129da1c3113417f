"""Point clouds of users, such as laser scans: PLY, PCD, LAS, LAZ and E57, recognised by their first bytes."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.text import install_command
from gsplat_edu.data.capture import Cloud, unit_colors
from gsplat_edu.data.points import Points, grey, read_ply

MOST_READ = 20_000_000
"""Of a larger file, every n-th point is read, so that at most this number is in memory."""

BYTE, WORD = 255.0, 65535.0
"""Full brightness of a colour of 8 bits and of 16."""


@dataclass(frozen=True, eq=False)
class PointFile:
    """The points of a file.

    Args:
        points: (N, 3) in the file's units, including NaN and infinity.
        colors: (N, 3) 0 to 1; None if the file has none.
        scan: Whether the file is of a format of scanners, and not a PLY.
        crs: Code of the coordinate reference system that a LAS, LAZ or E57 names; None if it names none, or as words
            only.
    """

    points: Points
    colors: Points | None
    scan: bool
    crs: str | None = None

    @property
    def cloud(self) -> Cloud:
        """The points, grey where the file has no colours."""
        return Cloud(self.points, grey(self.points) if self.colors is None else self.colors)


def read_points(path: Path) -> PointFile:
    """Read a point cloud in any of the formats.

    Args:
        path: PLY with x, y and z; PCD (ASCII or binary); LAS or LAZ; or E57, whose scans are joined.

    Raises:
        DatasetError: the file cannot be read, is of another format or damaged, or its library is not installed.
    """
    try:
        with open_file(path) as file:
            start = file.read(512)
    except (OSError, ValueError) as error:  # ValueError: invalid file name
        reason = getattr(error, "strerror", None) or str(error)
        raise DatasetError(f"{path}: cannot be read ({reason}); give a point cloud") from None
    for read, is_own, system in READERS:
        if is_own(start):
            points, colors = read(path)
            if not len(points):
                raise DatasetError(f"{path}: holds no points; export the scan again")
            return PointFile(points, colors, True, _code(system, path))
    return PointFile(*read_ply(path), False)


def _read_las(path: Path) -> tuple[Points, Points | None]:
    """Read coordinates with the file's scale and offset, in double, and colours."""
    laspy = _library("laspy", path)
    points, colors = list[Points](), list[Points]()
    try:
        with laspy.open(path) as file:
            step, first = _step(file.header.point_count), 0
            for chunk in file.chunk_iterator(1_000_000):
                some = slice(-first % step, None, step)
                first += len(chunk)
                points.append(_stacked([chunk.x, chunk.y, chunk.z], some))
                if {"red", "green", "blue"} <= set(chunk.point_format.dimension_names):
                    colors.append(_stacked([chunk.red, chunk.green, chunk.blue], some))
    except BaseException as error:  # a panic of Rust code, as of the decoder of LAZ, is no Exception
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            raise
        raise _damaged(path, "LAS", error) from None
    return _joined(points, colors)


def _las_system(path: Path) -> Any:  # noqa: ANN401
    """Return the system of a LAS as pyproj's object; None without one."""
    with _library("laspy", path).open(path) as file:
        return file.header.parse_crs()


def _read_e57(path: Path) -> tuple[Points, Points | None]:
    """Join the file's scans, each moved to its pose."""
    pye57 = _library("pye57", path)
    points, colors = list[Points](), list[Points]()
    try:
        with pye57.E57(str(path)) as file:
            headers = [file.get_header(i) for i in range(file.scan_count)]
            some = slice(None, None, _step(sum(header.point_count for header in headers)))
            for i, header in enumerate(headers):
                has_colors = {"colorRed", "colorGreen", "colorBlue"} <= set(header.point_fields)
                scan = file.read_scan(i, colors=has_colors, ignore_missing_fields=True)
                points.append(_stacked([scan[f"cartesian{axis}"] for axis in "XYZ"], some))
                if has_colors:
                    colors.append(_stacked([scan[f"color{name}"] for name in ("Red", "Green", "Blue")], some))
    except Exception as error:  # libE57Format's errors are plain exceptions
        raise _damaged(path, "E57", error) from None
    return _joined(points, colors)


def _e57_system(path: Path) -> Any:  # noqa: ANN401
    """Return the system of an E57, whose header has it as well-known text, as pyproj's object; None without one."""
    with _library("pye57", path).E57(str(path)) as file:
        name = "coordinateMetadata"
        text = file.root[name].value() if file.root.isDefined(name) else ""
    return importlib.import_module("pyproj").CRS.from_wkt(text) if text.strip() else None


def _code(system_of: Callable[[Path], Any], path: Path) -> str | None:
    """Return the code of a file's system, with that of its heights; None without one, or without pyproj to read it."""
    try:
        system = system_of(path)
    except Exception:  # without pyproj, or of a text that it does not know: many errors of three packages
        return None
    if system is None:
        return None
    codes = [part.to_epsg() for part in system.sub_crs_list or [system]]
    return None if None in codes else "EPSG:" + "+".join(map(str, codes))


def _step(count: int) -> int:
    """Return which of the points are read: every n-th."""
    return -(-count // MOST_READ) or 1


def _stacked(columns: Sequence[Any], some: slice) -> Points:
    return np.stack([np.asarray(column, np.float64)[some] for column in columns], axis=1)


def _joined(
    points: Sequence[Float64[np.ndarray, "_ 3"]], colors: Sequence[Float64[np.ndarray, "_ 3"]]
) -> tuple[Points, Points | None]:
    """Join parts of a scan. Their colours count if all have them; scanners without a camera write zeros."""
    if not points:
        return np.zeros((0, 3)), None
    whole = np.concatenate(points)
    if len(colors) < len(points) or not any(part.any() for part in colors):
        return whole, None
    rgb = np.concatenate(colors)
    return whole, unit_colors(rgb / (BYTE if rgb.max() <= BYTE else WORD))


def _read_pcd(path: Path) -> tuple[Points, Points | None]:
    """Read a PCD of the Point Cloud Library, with colours as packed rgb or rgba."""
    try:
        with open_file(path) as file:
            header = _pcd_header(file)
            table = _pcd_table(file, header)
    except (KeyError, ValueError, IndexError, OSError) as error:
        raise _damaged(path, "PCD", error) from None
    if not {"x", "y", "z"} <= set(table.dtype.names or ()):
        raise DatasetError(f"{path}: has no fields x, y and z; export the scan again")
    points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    packed = next((name for name in ("rgb", "rgba") if name in (table.dtype.names or ())), None)
    if packed is None:
        return points, None
    bits = np.ascontiguousarray(table[packed]).view(np.uint32)
    rgb = np.stack([(bits >> shift) & 0xFF for shift in (16, 8, 0)], axis=1)
    return points, unit_colors(rgb / BYTE)


def _pcd_header(file: Any) -> dict[str, list[str]]:  # noqa: ANN401
    """Return the words of each line up to DATA, by the line's first word."""
    found = dict[str, list[str]]()
    for _ in range(64):
        words = file.readline(4096).decode("ascii").split()
        if words and words[0] != "#":
            found[words[0]] = words[1:]
        if "DATA" in found:
            return found
    raise ValueError("no line DATA")


def _pcd_table(file: Any, header: dict[str, list[str]]) -> np.ndarray:  # noqa: ANN401
    counts = [int(word) for word in header.get("COUNT", ["1"] * len(header["FIELDS"]))]
    kinds = zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True)
    columns = [
        (f"{name}{i or ''}", f"<{kind.lower()}{int(size)}")
        for name, kind, size, count in kinds
        for i in range(count)
    ]
    padding = iter(range(len(columns)))
    dtype = np.dtype([(f"_{next(padding)}" if name == "_" else name, kind) for name, kind in columns])
    number, way = int(header["POINTS"][0]), header["DATA"][0]
    if number < 0 or dtype.itemsize == 0:
        raise ValueError(f"{number} points of {dtype.itemsize} bytes")
    if way == "ascii":
        rows = np.loadtxt(file, ndmin=2, max_rows=number, dtype=np.float64)
        table = np.zeros(len(rows), dtype)
        for column, name in zip(rows.T, dtype.names or (), strict=True):
            table[name] = column
    elif way == "binary":
        data = file.read(number * dtype.itemsize)
        table = np.frombuffer(data, dtype, len(data) // dtype.itemsize)
    else:
        raise ValueError(
            f"DATA {way}: save it as binary or ascii, for example with pcl_convert_pcd_ascii_binary"
        )
    if len(table) < number:
        raise ValueError(f"{len(table)} of {number} points")
    return table[:: _step(number)]


def _is_pcd(start: bytes) -> bool:
    return start.startswith(b"# .PCD") or (start.startswith(b"VERSION") and b"FIELDS" in start)


Reader = Callable[[Path], tuple[Points, Points | None]]

READERS: tuple[tuple[Reader, Callable[[bytes], bool], Callable[[Path], Any]], ...] = (
    (_read_las, lambda start: start.startswith(b"LASF"), _las_system),
    (_read_e57, lambda start: start.startswith(b"ASTM-E57"), _e57_system),
    (_read_pcd, _is_pcd, lambda path: None),
)
"""What reads a format, recognises it by a file's first bytes, and reads its system. All else is a PLY, or an error."""


def _library(name: str, path: Path) -> Any:  # noqa: ANN401
    try:
        return importlib.import_module(name)
    except ImportError:
        raise DatasetError(
            f"{path}: needs {name}, which is not installed: {install_command('scans')}"
        ) from None


def _damaged(path: Path, kind: str, error: BaseException) -> DatasetError:
    what = (str(error) or type(error).__name__).splitlines()[0]
    return DatasetError(f"{path}: cannot be read as {kind} ({what}); export the scan again")

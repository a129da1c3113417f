"""Inria's scene PLY, the common format of 3DGS viewers.

Written as binary little-endian float32 with one vertex per Gaussian and raw values (log scales, logit opacities): x y
z, nx ny nz (zero), f_dc_0..2, f_rest_* channel by channel, opacity, scale_0..2, rot_0..3 as (w, x, y, z). A scene of SH
degree 0 has no f_rest. Axes are those of the scene: nothing is flipped.

Properties are read by name, in any order and of any number type. The file may be binary of either byte order or ASCII.
An infinite logit means an opacity of 0 or 1. SuperSplat's packed files are also read. Of other properties, the 3D
filter of Mip-Splatting is applied (`FILTERS`), those of other kinds of splats are refused (`OTHER_KINDS`), and the rest
is ignored, as are other elements.

Metadata without a property is stored in comments: see `gsplat_edu.io.ply_comments`. One of them is the scene's
origin, to which the coordinates are relative. A file of another program has no origin: coordinates that float32 would
blur, such as doubles on a map, are split into an origin and the rest before they are rounded.

Source: the point_cloud.ply of Kerbl et al. 2023's code; Turk 1994, "The PLY Polygon File Format"; Yu et al. 2024,
"Mip-Splatting", eq. 8.

Chapter: 07_a_trained_scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from numpy.lib.recfunctions import structured_to_unstructured

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import BLOCK, Element, read_blocks, read_elements
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.io import compressed_ply
from gsplat_edu.io.ply_comments import comments, read_comments
from gsplat_edu.io.scene import Scene, split_origin
from gsplat_edu.scene.frame import ORIGIN, Vector, as_origin
from gsplat_edu.scene.gaussians import Gaussians

MEANS = ("x", "y", "z")
SH0 = tuple(f"f_dc_{i}" for i in range(3))
OPACITY = ("opacity",)
SCALES = tuple(f"scale_{i}" for i in range(3))
QUATS = tuple(f"rot_{i}" for i in range(4))

SH_REST_COUNTS = (0, 9, 24, 45)
"""Possible numbers of f_rest properties: three channels of the coefficients up to degrees 0 to 3."""

FILTERS = ("filter_3D", "filter_3d")
"""Names of the property with the standard deviation of a splat's 3D filter, world units: Mip-Splatting and its heirs,
such as Gaussian Opacity Fields, write scales and opacities without it and apply it when they render."""

OTHER_KINDS = {
    "trbf_*": "move and fade in time (Spacetime Gaussians)",
    "motion_*": "move in time",
    "omega_*": "turn in time",
    "shape": "have an exponent of their own (GES)",
    "beta": "have another kernel (Deformable Beta Splatting)",
    "sb_params_*": "have lobes of colour beside harmonics (Deformable Beta Splatting)",
    "sg_axis_*": "have lobes of colour beside harmonics (spherical Gaussians)",
    "f_offset_*": "are anchors of a neural scene (Scaffold-GS)",
}
"""Properties, by patterns of their names, of splats that are no 3D Gaussians with harmonics: drawn as those, they would
show another picture."""

LARGEST_LOGIT = 100.0
"""Replacement for an infinite logit: opacity 1 (or 0) in float32. Programs with 8-bit opacities write infinity."""


def read(path: Path, finite: bool = True) -> Scene:
    """Read a scene PLY and the metadata in its comments.

    Args:
        path: The file.
        finite: Reject NaN and infinite values.

    Returns:
        N Gaussians, raw parameters, float32, of the file's SH degree, and their origin. What `write` wrote is restored
        to the bit.

    Raises:
        SceneFormatError: not a scene PLY, or damaged: truncated, or with NaN or infinity (except for logits).
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        header = read_elements(path, file)
    if any("packed_position" in element.names for element in header.elements):
        return compressed_ply.read(path)
    antialiased, frame, is_placed = read_comments(path, header.comments)
    gaussians, origin = _load(path, finite, frame.origin if is_placed else None)
    return Scene(gaussians, antialiased, *frame._replace(origin=origin))


def write(path: Path, scene: Scene) -> None:
    """Write a scene PLY with its metadata in comments; see `save_ply`."""
    _write(path, scene.gaussians, comments(scene))


def save_ply(
    path: str | Path, gaussians: Gaussians, origin: ArrayLike = ORIGIN, antialiased: bool | None = None
) -> None:
    """Write Gaussians as a scene PLY.

    Args:
        path: Output file; parent folders are created.
        gaussians: N Gaussians, raw parameters; written as float32.
        origin: (3,) position of the means' zero in the capture's coordinates; stored in a comment if it is not zero.
        antialiased: Whether the Gaussians were trained for antialiased rendering, stored in a comment; None stores
            nothing.

    Raises:
        ShapeError: the origin is not of shape (3,).
        ArgumentError: a parameter is NaN or infinite.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    gaussians.check_finite()
    write(Path(path), Scene(gaussians, antialiased, origin=as_origin("origin", origin)))


def _write(path: Path, gaussians: Gaussians, extra: list[str]) -> None:
    tensors = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    count = len(gaussians)
    names = [*MEANS, "nx", "ny", "nz", *SH0, *rest_names(3 * tensors["sh_rest"].shape[1])]
    names += [*OPACITY, *SCALES, *QUATS]
    header = ["ply", "format binary_little_endian 1.0", *extra, f"element vertex {count}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    with written_aside(path) as aside, aside.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        for start in range(0, count, BLOCK):
            rows = {name: values[start : start + BLOCK] for name, values in tensors.items()}
            file.write(rows_of(rows).data)


def rows_of(tensors: Mapping[str, Float[np.ndarray, "N ..."]]) -> Float32[np.ndarray, "N P"]:
    """Return the columns of the file, normals included, of some Gaussians by the names of their tensors."""
    columns = (
        tensors["means"],
        np.zeros((len(tensors["means"]), 3)),  # normals
        tensors["sh0"][:, 0],
        np.concatenate(np.moveaxis(tensors["sh_rest"], 2, 0), axis=1),  # channel-major
        tensors["logit_opacities"][:, None],
        tensors["log_scales"],
        tensors["quats"],
    )
    return np.concatenate(columns, axis=1, dtype="<f4", casting="same_kind")


def load_ply(path: str | Path) -> Gaussians:
    """Read the Gaussians of a scene PLY, relative to its origin, which `read` returns with them; see there."""
    return read(Path(path)).gaussians


def _load(path: Path, finite: bool, origin: Vector | None) -> tuple[Gaussians, Vector]:
    """Return the Gaussians and their origin: that of a comment, or else the one that the positions need."""
    with open_file(path) as file:
        header = read_elements(path, file)
        vertex = splat_vertex(path, header.elements)
        rest = sum(name.startswith("f_rest_") for name in vertex.names)
        filters = tuple(name for name in FILTERS if name in vertex.names)
        groups = (MEANS, SH0, rest_names(rest), OPACITY, SCALES, QUATS, filters)
        columns = [name for group in groups for name in group]
        found, start, spoiled = None, 0, _Spoiled(path, columns)
        kinds = dict(vertex.properties)
        wide = any(kinds[name] != "f4" for name in MEANS)
        for table in read_blocks(path, file, header, vertex):
            values = _floats(table, columns)
            opacity = values[:, columns.index(OPACITY[0])]
            np.copyto(opacity, np.copysign(LARGEST_LOGIT, opacity), where=np.isinf(opacity))
            if finite:
                spoiled.look(values, start)
            if found is None:  # after the rows have been found to fit into the file and into memory
                found = _empty(vertex.count, rest // 3)
                positions = np.empty((vertex.count, 3), np.float64) if wide else found["means"]
            ends = np.cumsum([len(group) for group in groups])[:-1]
            means, sh0, sh_rest, opacity, scales, quats, widths = np.split(values, ends, axis=1)
            for k in range(len(filters)):
                _apply_filter(scales, opacity[:, 0], widths[:, k].astype(np.float64))
            rows = slice(start, start + len(values))
            positions[rows] = structured_to_unstructured(table[[*MEANS]], np.float64) if wide else means
            found["quats"][rows], found["log_scales"][rows] = quats, scales
            found["sh0"][rows, 0], found["logit_opacities"][rows] = sh0, opacity[:, 0]
            found["sh_rest"][rows] = np.moveaxis(sh_rest.reshape(len(values), 3, rest // 3), 1, 2)
            start += len(values)
    spoiled.check()
    assert found is not None  # there is at least one block, which may be empty
    if origin is None:
        positions, origin = split_origin(positions)
    found["means"] = positions.astype(np.float32, copy=False)
    return Gaussians(**{name: torch.from_numpy(values) for name, values in found.items()}), origin


def _apply_filter(
    log_scales: Float32[np.ndarray, "N 3"],
    logits: Float32[np.ndarray, " N"],
    widths: Float64[np.ndarray, " N"],
) -> None:
    """Convolve splats with isotropic Gaussians of the same integral, in place.

    With scales s and a filter of standard deviation f, both in world units, s becomes sqrt(s^2 + f^2) on each axis and
    the opacity is multiplied by the ratio of the volumes, sqrt(prod s^2 / prod (s^2 + f^2)).
    """
    rows = widths != 0
    if not rows.any():
        return
    with np.errstate(all="ignore"):  # NaN stays NaN; an opacity that rounds to 1 has an infinite logit
        before = log_scales[rows].astype(np.float64)
        after = 0.5 * np.logaddexp(2.0 * before, 2.0 * np.log(np.abs(widths[rows]))[:, None])
        log_opacity = -np.logaddexp(0.0, -logits[rows].astype(np.float64)) + (before - after).sum(axis=1)
        log_scales[rows] = after
        logits[rows] = np.minimum(log_opacity - np.log(-np.expm1(log_opacity)), LARGEST_LOGIT)


def _empty(count: int, rest: int) -> dict[str, Float32[np.ndarray, "N ..."]]:
    """Return room for the parameters of Gaussians."""
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "sh0": (1, 3), "sh_rest": (rest, 3)}
    shapes["logit_opacities"] = ()
    return {name: np.empty((count, *shape), np.float32) for name, shape in shapes.items()}


def _floats(table: np.ndarray, columns: list[str]) -> Float32[np.ndarray, "N P"]:
    """Return columns of a table as float32."""
    names, native = list(table.dtype.names or ()), np.dtype(np.float32)
    if all(
        table.dtype[name] == native for name in names
    ):  # the usual order of properties: one copy of all columns
        places = [names.index(name) for name in columns]
        return np.take(table.view(native).reshape(len(table), len(names)), places, axis=1)
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # a double beyond float32 becomes infinite, which is reported later
        return structured_to_unstructured(table[columns], dtype=np.float32)


def rest_names(count: int) -> tuple[str, ...]:
    """Return the names of a number of f_rest properties."""
    return tuple(f"f_rest_{i}" for i in range(count))


def splat_vertex(path: Path, elements: tuple[Element, ...]) -> Element:
    """Return the element `vertex` if it has all properties of a splat."""
    by_name = {element.name: element for element in elements}
    vertex = by_name.get("vertex")
    if vertex is None:
        raise SceneFormatError(f"{path}: is a PLY without vertices, not a splat scene; give a scene PLY")
    for name in vertex.names:
        if kind := next((kind for pattern, kind in OTHER_KINDS.items() if fnmatchcase(name, pattern)), None):
            raise SceneFormatError(
                f"{path}: its splats {kind}: property {name}; export them as 3D Gaussians with harmonics"
            )
    if SCALES[2] not in vertex.names and {*SH0, *OPACITY, *SCALES[:2], *QUATS} <= set(vertex.names):
        raise SceneFormatError(
            f"{path}: its splats are flat disks (2D Gaussian Splatting): lacks {SCALES[2]}; export them as 3D Gaussians"
        )
    missing = [name for name in (*MEANS, *SH0, *OPACITY, *SCALES, *QUATS) if name not in vertex.names]
    if missing:
        kind, advice = "not a splat scene", "export it again"
        if not {*SH0, *OPACITY, *SCALES, *QUATS} & set(vertex.names):
            kind = f"a {'mesh' if 'face' in by_name else 'point cloud'}, {kind}"
            advice = "give a scene PLY"
        raise SceneFormatError(f"{path}: is {kind}: lacks {', '.join(missing)}; {advice}")
    rest = [name for name in vertex.names if name.startswith("f_rest_")]
    if len(rest) not in SH_REST_COUNTS or set(rest) != set(rest_names(len(rest))):
        counts = ", ".join(str(count) for count in SH_REST_COUNTS)
        raise SceneFormatError(
            f"{path}: has {len(rest)} properties f_rest_*, but SH degrees 0-3 have {counts}, counted from 0"
        )
    return vertex


class _Spoiled:
    """NaN and infinite values of a file: the first, and how many vertices have one.

    Args:
        path: The file.
        columns: Names of the columns.
    """

    def __init__(self, path: Path, columns: list[str]) -> None:
        self._path, self._columns = path, columns
        self._first, self._count = "", 0

    def look(self, values: Float32[np.ndarray, "N P"], start: int) -> None:
        """Look through some rows, of which the first is the file's row `start`."""
        finite = np.isfinite(values)
        if finite.all():
            return
        if not self._count:
            row, column = np.argwhere(~finite)[0]
            self._first = f"vertex {start + row}: {self._columns[column]} is {values[row, column]}"
        self._count += int((~finite.all(axis=1)).sum())

    def check(self) -> None:
        """Raise a SceneFormatError if there are any."""
        if self._count:
            raise SceneFormatError(
                f"{self._path}: {self._first} ({self._count} such vertices in all); remove them or export the scene"
                " again"
            )

"""LCC of XGRIDS: a folder with levels of detail, of which the finest is read.

Beside a JSON file that may have any name ending in .lcc, little-endian:

    index.bin         for each cell of a grid: its number (uint32), and for each level the number of splats (uint32),
                      their offset in data.bin (uint64) and their size there in bytes (uint32); level 0 is the finest
    data.bin          splats of 32 bytes (`SPLAT`)
    shcoef.bin        64 bytes (`HARMONICS`) for each splat, at twice its offset in data.bin; unless "Portable"
    environment.bin   background, which belongs to no level: a splat and its harmonics each; may be missing

Scales are linear and harmonics of degree 3, both between the bounds of an attribute of the JSON. A packed colour has
11, 10 and 11 bits; a rotation (x, y, z, w) has 10 bits for each component but the largest, and 2 for the place of that.

Axes are those of the scene: z is up, a unit is a metre, and nothing is turned. Normals, collision meshes, "epsg",
"offset", "shift" and "scale" are not read; the white paper does not define the last three.

Source: XGRIDS' white paper on LCC (github.com/xgrids/LCCWhitepaper): "Data Organization Format originated from XGRIDS";
splat-transform 3.7 (MIT licence), for the bounds of files without a type or without an attribute of the environment.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, Shaped, UInt32, UInt64
from msgspec import Meta, Struct

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import open_file, parse_json, read_bytes
from gsplat_edu.base.records import record_of
from gsplat_edu.io.edit import joined
from gsplat_edu.io.lod.codec import file_of
from gsplat_edu.io.lod.meta import MOST_LEVELS
from gsplat_edu.io.quantize import MAX_SCALE, MIN_SCALE, byte_to_logit
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians

UP = (0.0, 0.0, 1.0)
"""Up direction of the scenes."""

UNIT = "m"
"""Their unit."""

SPLAT = np.dtype(
    [
        ("center", "<f4", 3),
        ("rgba", "u1", 4),
        ("scale", "<u2", 3),
        ("rotation", "<u4"),
        ("normal", "<u2", 3),
    ]
)
"""A splat."""

HARMONICS = np.dtype([("rgb", "<u4", 15), ("unused", "<u4")])
"""The harmonics of a splat, a packed colour for each coefficient."""

NONE = np.zeros(0, HARMONICS)
"""Harmonics of splats that have none."""

INDEX, DATA, SHCOEF, ENVIRONMENT = "index.bin", "data.bin", "shcoef.bin", "environment.bin"
"""Files beside the .lcc, in lower or upper case."""

RUN = np.dtype([("count", "<u4"), ("offset", "<u8"), ("bytes", "<u4")])
"""Where a level of a cell lies in data.bin."""

TYPES = {"Portable": False, "Quality": True}
"""Whether files of a type have harmonics."""

FARTHEST = 1 << 40
"""No file is as large, in bytes."""

_Bound = Annotated[float, Meta(ge=-MAX_SCALE, le=MAX_SCALE)]
_Vector = tuple[_Bound, _Bound, _Bound]


class _Attribute(Struct, frozen=True):
    """Bounds of a property of all splats."""

    name: str
    min: Any = None
    max: Any = None


class _Lcc(Struct, frozen=True, rename="camel"):
    """The contents of a .lcc."""

    total_level: Annotated[int, Meta(ge=1, le=MOST_LEVELS)]
    attributes: list[_Attribute]
    file_type: str | None = None
    encoding: str | None = None

    def bounds(self, *names: str) -> tuple[_Vector, _Vector]:
        """Return the smallest and largest values of the first attribute of some names that the file has."""
        known = {attribute.name: attribute for attribute in self.attributes}
        for name in names:
            if name in known:
                low: _Vector = record_of(f"attributes.{name}.min", known[name].min, _Vector)
                high: _Vector = record_of(f"attributes.{name}.max", known[name].max, _Vector)
                return low, high
        raise ArgumentError(f"attributes: has no {names[-1]}")

    @property
    def has_harmonics(self) -> bool:
        """Whether there is a shcoef.bin; files without a type have one if they say its bounds."""
        of_type = TYPES.get(self.file_type or "")
        return (
            any(attribute.name == "shcoef" for attribute in self.attributes) if of_type is None else of_type
        )


def read(path: Path) -> Scene:
    """Read the finest level of an LCC, and its environment.

    Args:
        path: The .lcc.

    Returns:
        The scene, float32: the cells in the order of the index, then the environment.

    Raises:
        SceneFormatError: a file is missing or damaged, or the files do not fit together.
        OSError: a file cannot be read.
    """
    document = read_document(path)
    try:
        scenes = _scenes(path, record_of("", document, _Lcc))
    except ArgumentError as error:
        raise SceneFormatError(f"{path}: is damaged ({error}); get it again") from None
    return finest(path, scenes)


def read_document(path: Path) -> Any:  # noqa: ANN401
    """Return the JSON of a .lcc or .lcc2.

    Raises:
        SceneFormatError: it is not JSON.
        OSError: the file cannot be read.
    """
    data = read_bytes(path)
    refuse_lfs_pointer(path, data)
    try:
        return parse_json(data, strict=True)
    except ValueError as error:
        reason = str(error).splitlines()[0][:80]
        raise SceneFormatError(f"{path}: is not JSON ({reason}); get the file again") from None


def finest(path: Path, scenes: list[Scene]) -> Scene:
    """Join the parts of a scene of XGRIDS.

    Args:
        path: The file's name for messages.
        scenes: The parts, without a frame.

    Raises:
        SceneFormatError: there are none.
    """
    if not scenes:
        raise SceneFormatError(f"{path}: has no splats at its finest level; get it again")
    return replace(joined(scenes), up=UP, unit=UNIT)


def files_of(path: Path) -> list[Path]:
    """Return the files of an LCC with splats, the .lcc first.

    Raises:
        SceneFormatError: a link leads out of the folder.
    """
    return [path, *filter(None, (_beside(path, name) for name in (INDEX, DATA, SHCOEF, ENVIRONMENT)))]


def _scenes(path: Path, meta: _Lcc) -> list[Scene]:
    """Return the finest level and the environment, as far as they have splats."""
    if meta.encoding not in (None, "COMPRESS"):
        raise ArgumentError("encoding: must be COMPRESS")
    runs = _runs(path, meta.total_level)
    splats, coefficients = _stored(path, DATA, SPLAT, runs["count"], runs["offset"]), NONE
    if meta.has_harmonics:
        coefficients = _stored(path, SHCOEF, HARMONICS, runs["count"], 2 * runs["offset"])
    scenes = [_scene(meta, splats, coefficients)] if len(splats) else []
    if (file := _beside(path, ENVIRONMENT)) is not None:
        layout = np.dtype([("splat", SPLAT), *([("harmonics", HARMONICS)] if meta.has_harmonics else [])])
        data = read_bytes(file)
        if len(data) % layout.itemsize:
            raise ArgumentError(f"{ENVIRONMENT}: is not a whole number of splats")
        stored = np.frombuffer(data, layout)
        if len(stored):
            coefficients = stored["harmonics"] if meta.has_harmonics else NONE
            scenes.append(_scene(meta, stored["splat"], coefficients, of="env"))
    return scenes


def _runs(path: Path, levels: int) -> Shaped[np.ndarray, " cells"]:
    """Return where the splats of the finest level of each cell lie in data.bin."""
    layout = np.dtype([("cell", "<u4"), ("runs", RUN, (levels,))])
    data = read_bytes(_there(path, INDEX))
    if len(data) % layout.itemsize:
        raise ArgumentError(f"{INDEX}: its cells do not have {levels} levels")
    runs: Shaped[np.ndarray, " cells"] = np.frombuffer(data, layout)["runs"][:, 0]
    runs = runs[runs["count"] > 0]
    if (runs["bytes"] != runs["count"].astype(np.uint64) * SPLAT.itemsize).any():
        raise ArgumentError(f"{INDEX}: number and size of a cell's splats differ")
    ordered = np.sort(runs, order="offset")
    ends = ordered["offset"] + ordered["bytes"]
    if (ordered["offset"] >= FARTHEST).any() or (ordered["offset"][1:] < ends[:-1]).any():
        raise ArgumentError(f"{INDEX}: the splats of two cells overlap")
    return runs


def _stored(
    path: Path,
    name: str,
    layout: np.dtype,
    counts: UInt32[np.ndarray, " cells"],
    offsets: UInt64[np.ndarray, " cells"],
) -> Shaped[np.ndarray, " N"]:
    """Return records from a file beside the .lcc, run by run."""
    parts = []
    with open_file(_there(path, name)) as file:
        for count, offset in zip(counts.tolist(), offsets.tolist(), strict=True):
            file.seek(offset)
            parts.append(file.read(count * layout.itemsize))
            if len(parts[-1]) != count * layout.itemsize:
                raise ArgumentError(f"{name}: is too short")
    return np.frombuffer(b"".join(parts), layout)


def _scene(
    meta: _Lcc, splats: Shaped[np.ndarray, " N"], harmonics: Shaped[np.ndarray, " N_or_0"], of: str = ""
) -> Scene:
    """Decode splats.

    Args:
        meta: Bounds of their values.
        splats: Their records.
        harmonics: Those of their harmonics, or `NONE`.
        of: "env" for those of the environment, which may have bounds of its own.
    """
    low, high = (np.array(bound) for bound in meta.bounds(f"{of}scale", "scale"))
    if (low < 0.0).any():
        raise ArgumentError("attributes: has a negative scale")
    share = splats["scale"] / 65535.0
    scales = (1.0 - share) * low + share * high
    rest = np.zeros((len(splats), 0, 3), np.float32)
    if meta.has_harmonics:
        least, most = (np.array(bound) for bound in meta.bounds(f"{of}shcoef", "shcoef"))
        rest = _coefficients(least, most, harmonics["rgb"])
    return Scene(
        Gaussians(
            means=torch.from_numpy(splats["center"].astype(np.float32)),
            quats=torch.from_numpy(_rotations(splats["rotation"])),
            log_scales=torch.from_numpy(np.log(np.maximum(scales, MIN_SCALE)).astype(np.float32)),
            sh0=torch.from_numpy(((splats["rgba"][:, None, :3] / 255.0 - SH_OFFSET) / C0).astype(np.float32)),
            sh_rest=torch.from_numpy(rest),
            logit_opacities=torch.from_numpy(byte_to_logit(splats["rgba"][:, 3])),
        )
    )


def _coefficients(
    low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"], packed: UInt32[np.ndarray, "N 15"]
) -> Float32[np.ndarray, "N 15 3"]:
    """Decode colours of 11, 10 and 11 bits."""
    rest = np.empty((*packed.shape, 3), np.float32)
    for channel, (shift, most) in enumerate(((0, 2047), (11, 1023), (21, 2047))):
        share = ((packed >> np.uint32(shift)) & np.uint32(most)) / most
        rest[:, :, channel] = (1.0 - share) * low[channel] + share * high[channel]
    return rest


def _rotations(packed: UInt32[np.ndarray, " N"]) -> Float32[np.ndarray, "N 4"]:
    """Decode quaternions, (w, x, y, z)."""
    bits = [(packed >> np.uint32(shift)) & np.uint32(1023) for shift in (0, 10, 20)]
    small = (np.stack(bits, axis=1) / 1023.0 - 0.5) * np.sqrt(2.0)
    largest = np.sqrt(1.0 - np.minimum((small**2).sum(axis=1), 1.0))
    place = (packed >> np.uint32(30)).astype(np.int64)
    xyzw = np.empty((len(packed), 4), np.float32)
    for omitted in range(4):
        rows = place == omitted
        xyzw[rows] = np.insert(small[rows], omitted, largest[rows], axis=1)
    return np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]])


def _beside(path: Path, name: str) -> Path | None:
    """Return the file of a name in the folder of the .lcc, in any case; None if there is none."""
    found = sorted(entry.name for entry in path.absolute().parent.iterdir() if entry.name.lower() == name)
    return file_of(path, found[0]) if found else None


def _there(path: Path, name: str) -> Path:
    """Return a file that has to be in the folder of the .lcc."""
    file = _beside(path, name)
    if file is None:
        raise SceneFormatError(f"{path}: {name} is missing beside it; get the whole folder again")
    return file

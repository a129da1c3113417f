"""USD: stages with ParticleField3DGaussianSplat, as text (.usda), binary (.usdc, by usd-core) or package (.usdz).

All values are float32 and activated, as in glTF: linear scales, opacities in 0 to 1, quaternions (w, x, y, z) of length
1, harmonics splat by splat with the constant first, of the same signs as ours. A package holds one layer of text. Text
has the shortest decimals that give a float32 back, and the same scene gives the same bytes.

USD's y points up: scenes are turned by half a turn about x (`gsplat_edu.io.axes.half_turned`). The prim around the
splats turns the scene's up direction to y and moves it to its origin, in double; metersPerUnit says the unit. What USD
has no place for (antialiased rendering; up and origin in the scene's axes; that no unit is known) is stored in the
layer's customLayerData. A file of ours is read back into the scene's own coordinates.

Files of any program are read by usd-core (`gsplat_edu.io.usd_stage`), with all prims of splats that are shown, their
transforms, either up axis, floats or halves. A metersPerUnit that is no unit of ours scales to metres. Hints about
sorting and projection are not followed. Refused in one line: shear, mirror, uneven scale, motion, other kernels,
references to other files. There is no reader of our own for text: the layers of a stage compose by rules that fill a
library, and a reader of our own files alone would refuse them once another program had saved them.

Source: Pixar, the schemas of UsdVol in OpenUSD 26.11. Some programs ask for the harmonics' elementSize and
interpolation, which the schema does not need.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from scipy.spatial.transform import Rotation

from gsplat_edu.base.constants import SH_MAX_DEGREE
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import BLOCK, LFS_POINTER, refuse_lfs_pointer
from gsplat_edu.base.reading import open_file
from gsplat_edu.io.axes import POSITION_SIGNS, half_turned, root_transform
from gsplat_edu.io.edit import joined
from gsplat_edu.io.glb_container import GENERATOR, refuse
from gsplat_edu.io.node_splats import Activated, is_same, moved, root_matrix
from gsplat_edu.io.scene import Scene, SceneFrame, extras, read_extras
from gsplat_edu.io.usd_package import require_usd, write_package
from gsplat_edu.io.usd_stage import MARK, SH, opened
from gsplat_edu.scene.frame import as_origin
from gsplat_edu.scene.gaussians import Gaussians

STARTS = {".usda": b"#usda ", ".usdc": b"PXR-USDC", ".usdz": b"PK\x03\x04"}
"""First bytes of a file by its suffix."""

METERS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres of each unit."""

LAYER = "scene.usda"
"""Name of the layer in a package."""

SPLATS = "/scene/splats"
"""Path of the prim of splats."""

REACH = 3.0
"""Standard deviations that `extent` encloses."""

Z_TO_Y = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])
"""From coordinates whose z points up to those whose y does."""


def write(path: Path, scene: Scene) -> None:
    """Write a scene as USD, in the form that the suffix indicates.

    Args:
        path: Output file; parent folders are created.
        scene: The scene, in this package's axes; written as float32.

    Raises:
        ArgumentError: a parameter is NaN, infinite, or beyond float32, a quaternion has zero length, usd-core is not
            installed for a .usdc, or a .usdz would exceed 2 GiB.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    gaussians = half_turned(scene.gaussians).map(torch.Tensor.float)
    gaussians.check_finite()
    values = Activated.of(gaussians)
    match path.suffix.lower():
        case ".usdc":
            _write_crate(path, scene, values)
        case ".usdz":
            text = (piece.encode("ascii") for piece in _layer(scene, values))
            write_package(path, [(LAYER, text)], "write a .usdc")
        case _:
            with written_aside(path) as aside, aside.open("w", encoding="ascii", newline="\n") as file:
                file.writelines(_layer(scene, values))


def _arrays(values: Activated) -> dict[tuple[str, str], Float32[np.ndarray, "..."]]:
    """Return the attributes by type and name."""
    return {
        ("point3f", "positions"): values.means,
        ("quatf", "orientations"): values.quats,
        ("float3", "scales"): values.scales,
        ("float", "opacities"): values.opacities,
        ("float3", f"{SH}Coefficients"): values.sh.reshape(-1, 3),
    }


def _layer(scene: Scene, values: Activated, *, filled: bool = True) -> Iterator[str]:
    """Yield the text of a layer in pieces; the arrays are empty unless `filled`."""
    coefficients = values.sh.shape[1]
    reach = REACH * values.scales.astype(np.float64).max(axis=1, keepdims=True, initial=0.0)
    corners = np.zeros((2, 3))
    if len(values.means):
        corners = np.array([(values.means - reach).min(axis=0), (values.means + reach).max(axis=0)])
    most = float(np.finfo(np.float32).max)
    meters = METERS[scene.unit] if scene.unit else 1.0
    yield "#usda 1.0\n(\n    customLayerData = {\n"
    yield f"        dictionary {MARK} = {{\n" + "".join(_mark(scene)) + "        }\n    }\n"
    yield f'    defaultPrim = "scene"\n    metersPerUnit = {meters!r}\n    upAxis = "Y"\n)\n\n'
    yield (
        'def Xform "scene"\n{\n'
        + _operations(scene)
        + '    def ParticleField3DGaussianSplat "splats"\n    {\n'
    )
    yield f"        float3[] extent = [{_tuples(np.clip(corners, -most, most).astype(np.float32))}]\n"
    for (kind, name), array in _arrays(values).items():
        yield f"        {kind}[] {name} = ["
        for start in range(0, len(array) if filled else 0, BLOCK):
            yield ("," if start else "") + _tuples(array[start : start + BLOCK])
        yield "]"
        if name.startswith(SH):
            yield f' (\n            elementSize = {coefficients}\n            interpolation = "vertex"\n        )'
        yield "\n"
    yield f"        uniform int {SH}Degree = {round(coefficients**0.5) - 1}\n"
    yield '        uniform token projectionModeHint = "perspective"\n'
    yield '        uniform token sortingModeHint = "zDepth"\n    }\n}\n'


def _mark(scene: Scene) -> Iterator[str]:
    """Yield the lines of our dictionary, in the order of the alphabet."""
    known: dict[str, Any] = {"generator": GENERATOR, **extras(scene.frame)}
    if scene.antialiased is not None:
        known["antialiased"] = scene.antialiased
    for key in sorted(known):
        match known[key]:
            case bool(value):
                yield f"            bool {key} = {int(value)}\n"
            case str(value):
                yield f'            string {key} = "{value}"\n'
            case value:
                yield f"            double3 {key} = {_tuple(value)}\n"


def _operations(scene: Scene) -> str:
    """Return the lines of the prim's transform: turn the scene upright, then move it to its origin."""
    turn, shift = root_transform(scene.up, scene.origin)
    lines = {}
    if shift.any():
        lines["xformOp:translate"] = f"double3 xformOp:translate = {_tuple(shift.tolist())}"
    if not np.array_equal(turn, np.eye(3)):
        quat = Rotation.from_matrix(turn).as_quat(scalar_first=True)
        lines["xformOp:orient"] = f"quatd xformOp:orient = {_tuple(quat.tolist())}"
    if not lines:
        return ""
    order = ", ".join(f'"{name}"' for name in lines)
    return "".join(f"    {line}\n" for line in lines.values()) + (
        f"    uniform token[] xformOpOrder = [{order}]\n\n"
    )


def _tuple(numbers: list[float]) -> str:
    return f"({', '.join(map(repr, numbers))})"


def _tuples(array: Float32[np.ndarray, "..."]) -> str:
    """Return numbers, or rows of numbers, as text."""
    texts = array.astype(str).tolist()
    return ",".join(texts) if array.ndim == 1 else ",".join(f"({','.join(row)})" for row in texts)


def _write_crate(path: Path, scene: Scene, values: Activated) -> None:
    """Write a binary layer: the text without arrays, read by usd-core, and the arrays."""
    require_usd(str(path))
    from pxr import Sdf, Vt

    types = {
        "point3f": Vt.Vec3fArray,
        "quatf": Vt.QuatfArray,
        "float3": Vt.Vec3fArray,
        "float": Vt.FloatArray,
    }
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    layer.ImportFromString("".join(_layer(scene, values, filled=False)))
    for (kind, name), array in _arrays(values).items():
        own = array[:, [1, 2, 3, 0]] if kind == "quatf" else array  # usd-core's memory has w last
        layer.GetAttributeAtPath(f"{SPLATS}.{name}").default = types[kind].FromNumpy(
            np.ascontiguousarray(own)
        )
    with written_aside(path) as aside:
        layer.Export(str(aside))


def read(path: Path) -> Scene:
    """Read a stage of any program.

    Args:
        path: The file.

    Returns:
        The scene, float32, in this package's axes; in its own coordinates if the file is ours.

    Raises:
        ArgumentError: usd-core is not installed.
        SceneFormatError: the file is damaged, holds no splats, or what it holds cannot be drawn as this package does.
        OSError: the file cannot be read.
    """
    start = STARTS[path.suffix.lower()]
    with open_file(path) as file:
        first = file.read(len(LFS_POINTER))
    refuse_lfs_pointer(path, first)
    if not first.startswith(start):
        refuse(path, f"is no {path.suffix.lower()}: it does not begin with {start!r}"[:120])
    require_usd(str(path))
    facts, arrays = opened(path)
    if "fault" in facts:
        refuse(path, facts["fault"])
    known = facts["mark"] or {}
    try:
        frame = read_extras(known)
    except ValueError:
        refuse(path, "has an origin or a place on earth that is none")
    if (antialiased := known.get("antialiased")) not in (None, True, False):
        refuse(path, f"says antialiased is {antialiased!r}"[:80])
    matrices = [np.array(prim["matrix"]) for prim in facts["prims"]]
    root, whole = root_matrix(frame.up, frame.origin), np.eye(4)
    if not (known and facts["up"] == "Y" and all(is_same(matrix, root) for matrix in matrices)):
        frame, root = SceneFrame(unit=frame.unit), np.eye(4)
        whole = Z_TO_Y if facts["up"] == "Z" else whole
    if not (known and facts["meters"] == METERS.get(frame.unit or "m")):
        unit, size = _unit(path, facts["meters"])
        frame = frame._replace(unit=unit, earth=None)
        whole = np.diag([size, size, size, 1.0]) @ whole
    parts = [
        moved(path, Scene(_gaussians(path, prim, values)), whole @ matrix, root)
        for prim, matrix, values in zip(facts["prims"], matrices, arrays, strict=True)
    ]
    scene = joined(parts)
    if not any(frame.origin):
        frame = frame._replace(origin=as_origin("origin", np.array(POSITION_SIGNS) * scene.origin + 0.0))
    return Scene(half_turned(scene.gaussians), antialiased, *frame)


def _unit(path: Path, meters: float | None) -> tuple[str | None, float]:
    """Return the unit that a stage's metersPerUnit leads to, and how many of it a unit of the stage is."""
    if meters is None:
        return None, 1.0
    if not 0.0 < meters < np.inf:
        refuse(path, f"says {meters!r} metres per unit")
    near = (unit for unit, size in METERS.items() if np.isclose(meters, size, rtol=1e-6, atol=0.0))
    unit = next(near, None)
    return (unit, 1.0) if unit else ("m", meters)


def _gaussians(path: Path, prim: Mapping[str, Any], values: Mapping[str, np.ndarray]) -> Gaussians:
    """Return the Gaussians of a prim in its own coordinates."""
    count, degree = len(values["positions"]), prim["degree"]
    if type(degree) is not int or not 0 <= degree <= SH_MAX_DEGREE:
        refuse(path, f"has harmonics of degree {degree!r}; degrees 0 to {SH_MAX_DEGREE} are read"[:120])
    each = (degree + 1) ** 2
    for name, found in values.items():
        expected = count * (each if name.startswith(SH) else 1)
        if len(found) != expected:
            refuse(path, f"has {count:,} positions, but {len(found):,} {name}, not {expected:,}")
        if not np.isfinite(found).all():
            refuse(path, f"has NaN or infinite values in {name}")
    means, quats, scales, opacities, sh = values.values()
    return Activated(means, quats, scales, opacities, sh.reshape(count, each, 3)).gaussians(path)

"""The process in which usd-core opens a file: damaged binary layers end the process that reads them.

    python -m gsplat_edu.io.usd_stage FILE FOUND

`opened` starts it. It has little more memory and time than the file's size justifies, because references may multiply
what a file describes. No other file is opened: what refers to one outside its own package is refused.

Source: Pixar, the schemas of UsdVol in OpenUSD 26.11.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save_file

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.files import named_in_utf8
from gsplat_edu.base.text import printable, shortened
from gsplat_edu.io.quantize import MAX_EXPANSION, SMALL

MARK = "gsplat_edu"
"""Key of our dictionary in the layer's customLayerData."""

SH = "radiance:sphericalHarmonics"
"""Beginning of the names of the harmonics' attributes."""

ATTRIBUTES = {
    "positions": ("Vec3", 3),
    "orientations": ("Quat", 4),
    "scales": ("Vec3", 3),
    "opacities": ("", 0),
    f"{SH}Coefficients": ("Vec3", 3),
}
"""Beginnings of usd-core's types, and numbers per item, of the attributes of splats; in halves, names end in h."""

KERNEL = "ParticleFieldKernelGaussianEllipsoidAPI"
"""Schema of fields whose particles are Gaussians in three dimensions."""

MOST_PRIMS = 1 << 18
"""Most prims of a stage, instances included."""

LIBRARIES = 4 << 30
"""Bytes of addresses that usd-core, NumPy and Python take themselves, and more."""

TIMES = 256
"""Further bytes for each byte of the file: the parser of text keeps each number of an array as a value of its own."""

SECONDS, BYTES_PER_SECOND = 60, 1 << 20
"""Seconds of computing that any file may take, and the bytes of a larger one for which there is another second."""

ONE_THREAD = {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Threads would take addresses."""

LAST_WORDS = 200
"""Characters of what a failed process printed last that a message repeats."""


class UnreadableStageError(Exception):
    """What is wrong with a file."""


def opened(path: Path) -> tuple[dict[str, Any], list[dict[str, np.ndarray]]]:
    """Return what usd-core finds in a file: facts of the stage, and the arrays of each prim of splats.

    Args:
        path: A .usda, .usdc or .usdz.

    Returns:
        The facts: `fault`, if there is one, else `up` ("Y" or "Z"), `meters` per unit (None if not said), `mark` (our
        dictionary, or None) and `prims` with `path`, `matrix` (4 by 4, to the stage's coordinates) and `degree`. And
        `ATTRIBUTES` by name, in float32 or float64; quaternions are (w, x, y, z).

    Raises:
        SceneFormatError: usd-core cannot read the file.
    """
    with tempfile.TemporaryDirectory() as folder, named_in_utf8(path) as named:
        found = Path(folder, "found")
        command = [sys.executable, "-P", "-m", "gsplat_edu.io.usd_stage", str(named), str(found)]
        environment = os.environ | ONE_THREAD
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, check=False, env=environment
        )
        if done.returncode or not found.is_file():
            said = done.stderr.decode(errors="replace").strip().splitlines()
            last = f": {said[-1][:LAST_WORDS]}" if said and done.returncode > 0 else ""
            why = f"signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
            raise SceneFormatError(
                f"{path}: usd-core cannot read it ({why}{last}); it is damaged or needs too much memory, export it"
                " again"
            )
        with safe_open(found, "np") as file:
            facts = json.loads(file.metadata()["facts"])
            prims = facts.get("prims", ())
            arrays = [
                {name: file.get_tensor(f"{k} {name}") for name in ATTRIBUTES} for k in range(len(prims))
            ]
    return facts, arrays


def main(path: str, found: str) -> None:
    """Open a file, and write what it holds."""
    size = Path(path).stat().st_size
    _limit(size)
    from pxr import Tf, UsdUtils

    silent = UsdUtils.CoalescingDiagnosticDelegate()  # keeps what it would print
    arrays: dict[str, np.ndarray] = {}
    try:
        facts = _facts(path, arrays, max(SMALL, MAX_EXPANSION * size))
    except UnreadableStageError as error:
        facts, arrays = {"fault": str(error)}, {}
    except (Tf.ErrorException, UnicodeDecodeError) as error:
        facts, arrays = {"fault": f"is damaged, or no USD file{_place(path, error)}"}, {}
    del silent
    save_file(arrays, found, {"facts": json.dumps(facts)})


def _limit(size: int) -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    resource.setrlimit(resource.RLIMIT_AS, (LIBRARIES + TIMES * size,) * 2)
    seconds = SECONDS + size // BYTES_PER_SECOND
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _place(path: str, error: Exception) -> str:
    """Return which line of a text usd-core complains about; nothing if it does not say."""
    try:
        line = re.search(rf"{re.escape(path)}:(\d+):", str(error))
    except UnicodeDecodeError:  # it repeats what it could not read
        return ""
    return f": line {line[1]} cannot be read" if line else ""


def _facts(path: str, arrays: dict[str, np.ndarray], room: int) -> dict[str, Any]:
    """Return the facts of a stage; put arrays of at most `room` bytes into `arrays`."""
    from pxr import Sdf, Usd, UsdGeom

    layer = Sdf.Layer.FindOrOpen(path)
    if layer is None:
        raise UnreadableStageError("is damaged, or no USD file")
    _check_references(layer, f"{path}[" if path.lower().endswith(".usdz") else None)
    stage = Usd.Stage.Open(layer)
    cache = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    prims: list[dict[str, Any]] = []
    for prim in _splats(stage):
        if any(UsdGeom.Xformable(over).TransformMightBeTimeVarying() for over in _and_above(prim)):
            raise UnreadableStageError("has splats that move over time, and only still ones are read")
        for name, (kind, width) in ATTRIBUTES.items():
            values = _values(prim, name, kind, width)
            room -= values.nbytes
            if room < 0:
                raise UnreadableStageError(f"shows its splats more than {MAX_EXPANSION} times")
            arrays[f"{len(prims)} {name}"] = values
        matrix = np.array(cache.GetLocalToWorldTransform(prim)).T  # USD multiplies rows
        degree = prim.GetAttribute(f"{SH}Degree").Get(Usd.TimeCode.EarliestTime())
        prims.append({"path": str(prim.GetPath()), "matrix": matrix.tolist(), "degree": degree})
    meters = UsdGeom.GetStageMetersPerUnit(stage)
    mark = layer.customLayerData.get(MARK)
    return {
        "up": UsdGeom.GetStageUpAxis(stage),
        "meters": meters if UsdGeom.StageHasAuthoredMetersPerUnit(stage) else None,
        "mark": {key: _plain(value) for key, value in mark.items()} if isinstance(mark, dict) else None,
        "prims": prims,
    }


def _plain(value: Any) -> object:  # noqa: ANN401 - of a stranger's layer
    """Return a value of a layer's metadata as JSON has it; None for those that we do not write."""
    from pxr import Gf

    if isinstance(value, Gf.Vec3d):
        return list(value)
    return value if isinstance(value, str | bool) else None


def _check_references(layer: Any, inside: str | None) -> None:  # noqa: ANN401
    """Refuse a layer that, or a layer of whose package, would open a file beyond it.

    Args:
        layer: The first layer.
        inside: Beginning of the names of layers in the package; None if there is none.
    """
    from pxr import Sdf

    waiting, seen = [layer], set()
    while waiting:
        layer = waiting.pop()
        seen.add(layer.identifier)
        paths: list[Any] = []
        layer.Traverse(Sdf.Path.absoluteRootPath, paths.append)
        if any(path.IsPrimPath() and layer.GetPrimAtPath(path).HasInfo("clips") for path in paths):
            raise UnreadableStageError("has splats that move over time (clips), and only still ones are read")
        for name in layer.GetCompositionAssetDependencies():
            whole = Sdf.ComputeAssetPathRelativeToLayer(layer, name)
            if inside is None or not whole.startswith(inside):
                raise UnreadableStageError(
                    f"refers to another file, {shortened(printable(name))}, which is not opened; make one file of"
                    " all with usdcat --flatten"
                )
            if whole not in seen:
                further = Sdf.Layer.FindOrOpen(whole)
                if further is None:
                    raise UnreadableStageError(f"lacks {shortened(printable(name))}, to which it refers")
                waiting.append(further)


def _and_above(prim: Any) -> Iterator[Any]:  # noqa: ANN401
    """Yield a prim and those that it lies in."""
    while prim and not prim.IsPseudoRoot():
        yield prim
        prim = prim.GetParent()


def _splats(stage: Any) -> Iterator[Any]:  # noqa: ANN401
    """Yield the prims of splats that a renderer would show.

    Raises:
        UnreadableStageError: there is none, or one has another kernel.
    """
    from pxr import Usd, UsdGeom

    shown, hidden, others = 0, 0, set()
    prims = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    for number, prim in enumerate(prims):
        if number > MOST_PRIMS:
            raise UnreadableStageError(f"has more than {MOST_PRIMS:,} prims, instances included")
        kind = prim.GetTypeName()
        if not kind.startswith("ParticleField"):
            others.add(kind)
            if kind == "PointInstancer":  # shows copies of what it holds, elsewhere
                prims.PruneChildren()
            continue
        image = UsdGeom.Imageable(prim)
        purposes = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
        if image.ComputeVisibility() == UsdGeom.Tokens.invisible or image.ComputePurpose() not in purposes:
            hidden += 1
            continue
        if KERNEL not in prim.GetAppliedSchemas():
            raise UnreadableStageError(
                f"has particles of the kind {shortened(printable(kind))}, which are no 3D Gaussians"
            )
        shown += 1
        yield prim
    if not shown:
        named = shortened(printable(", ".join(sorted(others - {"", "Xform", "Scope"}))))
        found = (
            f"its {hidden} prims of splats are invisible" if hidden else f"it holds {named or 'no shapes'}"
        )
        raise UnreadableStageError(f"has no splats that are shown (ParticleField3DGaussianSplat): {found}")


def _values(prim: Any, name: str, kind: str, width: int) -> np.ndarray:  # noqa: ANN401
    """Return the values of an attribute, or of the one in halves if it is empty."""
    from pxr import Usd

    best = np.empty((0, width) if width else 0, np.float32)
    for attribute in (prim.GetAttribute(name), prim.GetAttribute(f"{name}h")):
        if attribute.GetNumTimeSamples() > 1:
            raise UnreadableStageError("has splats that move over time, and only still ones are read")
        found = attribute.Get(Usd.TimeCode.EarliestTime())
        if found is None:
            continue
        said, best = type(found).__name__, np.array(found)  # the attribute itself has the schema's type
        if not said.startswith(kind) or best.dtype.kind != "f" or best.ndim != 1 + bool(width):
            raise UnreadableStageError(f"has {name} of the type {said}")
        if len(best):
            break
    if kind == "Quat":
        best = best[:, [3, 0, 1, 2]]
    return np.ascontiguousarray(best, best.dtype if best.dtype == np.float64 else np.float32)


if __name__ == "__main__":
    main(*sys.argv[1:])

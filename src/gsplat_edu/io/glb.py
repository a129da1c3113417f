"""Binary glTF 2.0 with KHR_gaussian_splatting: the scene as a mesh of points, which glTF viewers can display.

All values are float32 and activated: linear scales, opacities in 0..1, quaternions (x, y, z, w) of length 1. They are
exact to float32, but logits above 17 and the length of a quaternion are lost. Scales above e^88, near the end of
float32, are clamped. SH coefficients have glTF's signs, which equal ours, one attribute per coefficient. Further
metadata is stored in the asset's extras: up, unit and origin as in `gsplat_edu.io.scene.extras`. A scene without
Gaussians is written without a mesh, because glTF has no empty meshes.

glTF's y points up. Scenes are converted by a half turn about x (`gsplat_edu.io.axes.half_turned`), as in SPZ: what
faced a camera that looks along our z then faces glTF's +z, its front. The half turn changes means, rotations and
harmonics. A scene with another up direction or an origin is turned and moved by its node's transform, in double, which
keeps the bits of the splats. Some programs turn about z instead; their files differ from ours by a half turn about y.

Files of any program are read if they store the data in the same plain way: one mesh primitive with the extension,
float32 attributes packed tightly in the file's own buffer, and no transform on the node. Anything else is rejected with
an error that names it.

Source: Khronos, "glTF 2.0 Specification" and the extension KHR_gaussian_splatting, in which scales are linear; drafts
before April 2026 had logarithms.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsplat_edu.base.constants import SH_MAX_DEGREE
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.io.axes import half_turned, root_transform
from gsplat_edu.io.glb_container import container, refuse, root_node, write_container
from gsplat_edu.io.quantize import unit_quats
from gsplat_edu.io.scene import Scene, extras, read_extras
from gsplat_edu.scene.gaussians import Gaussians

EXTENSION = "KHR_gaussian_splatting"

POINTS, FLOAT, ARRAY_BUFFER = 0, 5126, 34962
"""Mode of a primitive; component type of an accessor; target of a buffer view."""

TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
"""Type of an accessor by its number of components."""

LARGEST_LOG_SCALE = 88.0
"""exp of this is just below the largest float32."""

OPAQUE = 2.0**-24
"""Opacities are kept this far from 0 and 1 (half a float32 step at 1), so that their logits are finite."""

TRANSFORMS = ("matrix", "rotation", "scale", "translation")


def write(path: Path, scene: Scene) -> None:
    """Write a scene as binary glTF.

    Args:
        path: Output file; parent folders are created.
        scene: The scene, in this package's axes; written as float32.

    Raises:
        ArgumentError: a parameter is NaN, infinite, or beyond float32, a quaternion has zero length, or there are more
            Gaussians than fit into the format's 4 GiB.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    gaussians = half_turned(scene.gaussians).map(torch.Tensor.float)
    gaussians.check_finite()
    attributes = _attributes(gaussians) if len(gaussians) else {}
    parts = list(attributes.values())
    write_container(path, _description(scene, attributes), parts, f"{len(gaussians):,} Gaussians")


def _attributes(gaussians: Gaussians) -> dict[str, Float32[np.ndarray, "N C"]]:
    """Return the values of every attribute by name."""
    raw = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    with np.errstate(over="ignore"):  # exp overflows to infinity: the opacity is 0
        opacities = 1.0 / (1.0 + np.exp(-raw["logit_opacities"].astype(np.float64)))
    scales = np.exp(np.minimum(raw["log_scales"].astype(np.float64), LARGEST_LOG_SCALE))
    arrays = {
        "POSITION": raw["means"],
        f"{EXTENSION}:ROTATION": unit_quats(raw["quats"])[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities[:, None],
    }
    coefficients = np.concatenate([raw["sh0"], raw["sh_rest"]], axis=1)
    for degree in range(gaussians.sh_degree + 1):
        for order in range(2 * degree + 1):
            arrays[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = coefficients[:, degree**2 + order]
    return {name: array.astype("<f4") for name, array in arrays.items()}


def _description(scene: Scene, attributes: dict[str, Float32[np.ndarray, "N C"]]) -> dict[str, Any]:
    """Return the JSON: a scene of one node, one mesh, one primitive; a buffer view and an accessor per attribute."""
    asset: dict[str, Any] = {"version": "2.0", "generator": "gsplat-edu"}
    known = extras(scene.up, scene.unit, scene.origin)
    if scene.antialiased is not None:
        known["antialiased"] = scene.antialiased
    if known:
        asset["extras"] = known
    if not attributes:
        return {"asset": asset, "scene": 0, "scenes": [{"name": "empty"}]}
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, int]] = []
    start = 0
    for index, array in enumerate(attributes.values()):
        count, width = array.shape
        accessors.append({"bufferView": index, "componentType": FLOAT, "count": count, "type": TYPES[width]})
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": ARRAY_BUFFER})
        start += array.nbytes
    position = attributes["POSITION"]
    accessors[0] |= {"min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist()}
    kind = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": POINTS,
        "extensions": {EXTENSION: kind},
    }
    return {
        "asset": asset,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **root_node(*root_transform(scene.up, scene.origin))}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }


def read(path: Path) -> Scene:
    """Read a binary glTF; see `gsplat_edu.io.formats.read_scene`."""
    data = read_bytes(path)
    document, body = container(path, data)
    try:
        return _scene(path, document, body)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError):
        refuse(path, "its JSON does not describe splats as glTF does")


def _scene(path: Path, document: dict[str, Any], body: memoryview) -> Scene:
    found_extras = document["asset"].get("extras", {})
    antialiased = found_extras.get("antialiased")
    up, unit, origin = read_extras(found_extras)
    if antialiased not in (None, True, False):
        refuse(path, f"says antialiased is {antialiased!r}"[:80])
    found = [
        primitive
        for mesh in document.get("meshes", [])
        for primitive in mesh["primitives"]
        if EXTENSION in primitive.get("extensions", {})
    ]
    if not found and (body or document.get("meshes")):
        refuse(path, f"has no splats: no primitive with {EXTENSION}")
    if len(found) > 1:
        refuse(path, f"has {len(found)} primitives of splats, but only one is supported")
    own = {**root_node(*root_transform(up, origin)), "mesh": 0}
    if any(name in node for node in document.get("nodes", []) for name in TRANSFORMS) and document[
        "nodes"
    ] != [own]:
        refuse(path, "transforms its splats by a node; apply the transform first")
    attributes = found[0]["attributes"] if found else {}
    arrays = {
        name: _array(path, document, body, index) for name, index in attributes.items() if index is not None
    }
    return Scene(half_turned(_gaussians(path, arrays)), antialiased, up, unit, origin)


def _array(path: Path, document: dict[str, Any], body: memoryview, index: int) -> Float32[np.ndarray, "N C"]:
    """Return the values of an accessor."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    widths = [width for width, name in TYPES.items() if name == accessor["type"]]
    if accessor["componentType"] != FLOAT or not widths or "sparse" in accessor:
        refuse(path, f"has attributes that are not float32 (accessor {index})")
    count, size = accessor["count"], 4 * widths[0]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if view.get("byteStride", size) != size or view.get("buffer", 0) != 0:
        refuse(path, f"has attributes that are interleaved or in another file (accessor {index})")
    if not (
        type(count) is type(start) is int and count >= 0 and 0 <= start <= start + count * size <= len(body)
    ):
        refuse(path, f"has an attribute that extends beyond the file's end (accessor {index})")
    numbers = np.frombuffer(body, "<f4", count * widths[0], start)
    if not np.isfinite(numbers).all():
        refuse(path, f"has NaN or infinite values (accessor {index})")
    return numbers.reshape(count, widths[0])


def _gaussians(path: Path, arrays: dict[str, Float32[np.ndarray, "N C"]]) -> Gaussians:
    """Return the Gaussians in glTF's axes."""
    degree = -1
    while degree < SH_MAX_DEGREE and f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in arrays:
        degree += 1
    harmonics = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{k}" for d in range(degree + 1) for k in range(2 * d + 1)]
    names = ["POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")), *harmonics]
    widths = [3, 4, 3, 1, *[3] * len(harmonics)]
    if not arrays:
        arrays = {name: np.empty((0, width), np.float32) for name, width in zip(names, widths, strict=True)}
    elif not harmonics:
        refuse(path, "has splats without colour")
    missing = [name for name in names if name not in arrays]
    if missing:
        refuse(path, f"has splats without {missing[0]}")
    values = [arrays[name] for name in names]
    count = len(values[0])
    if [value.shape for value in values] != [(count, width) for width in widths]:
        refuse(path, "has attributes of different numbers of splats")
    means, quats, scales, opacities = (value.astype(np.float64) for value in values[:4])
    if not ((scales >= 0).all() and ((opacities >= 0) & (opacities <= 1)).all()):
        refuse(path, "has a negative scale or an opacity outside 0 to 1")
    tiny = np.finfo(np.float32).smallest_subnormal
    inside = np.clip(opacities[:, 0], OPAQUE, 1.0 - OPAQUE)
    sh = np.stack(values[4:], axis=1) if harmonics else np.empty((count, 1, 3))
    tensors = (
        means,
        quats[:, [3, 0, 1, 2]],
        np.log(np.maximum(scales, tiny)),
        sh[:, :1],
        sh[:, 1:],
        np.log(inside / (1.0 - inside)),
    )
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)) for array in tensors))

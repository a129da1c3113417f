"""Binary glTF 2.0 with KHR_gaussian_splatting: the scene as points of a mesh, which viewers of glTF know how to draw.

Written, not read. Everything is float32. What is stored are activated values: scales, not their logarithms, opacities,
not their logits, quaternions (x, y, z, w) of length 1; each is right to float32, but what a logit above 17 or a
quaternion's length was is lost. Scales above e^88, about where float32 ends, are clamped. Coefficients have glTF's
signs, which are ours, one attribute each. What is known of the scene besides is in the asset's extras, up as glTF has
it. A scene without Gaussians is a file without a mesh, because glTF has no empty ones.

glTF's y points up. Scenes get there by half a turn about x (`gsplat_edu.io.axes.half_turned`), as in SPZ: what faced
a camera looking along our z, then faces glTF's +z, which glTF calls the front. Means, rotations and harmonics are
turned, not the node: viewers do not all turn harmonics along with it. Some programs turn about z instead; their
files differ from ours by half a turn about y.

Source: Khronos, "glTF 2.0 Specification" and extension KHR_gaussian_splatting, where scales are linear; drafts before
April 2026 had logarithms.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsplat_edu.errors import ArgumentError
from gsplat_edu.files import written_aside
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.io.axes import POSITION_SIGNS, half_turned
from gsplat_edu.io.scene import Scene
from gsplat_edu.io.spz_values import unit_quats

EXTENSION = "KHR_gaussian_splatting"

FILE_HEADER = struct.Struct("<4sII")
"""glTF, version 2, length of the file."""

CHUNK_HEADER = struct.Struct("<I4s")
"""Length, kind."""

POINTS, FLOAT, ARRAY_BUFFER = 0, 5126, 34962
"""Mode of a primitive; component type of an accessor; target of a buffer view."""

TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
"""Type of an accessor by the numbers it has per splat."""

LARGEST_LOG_SCALE = 88.0
"""exp of it is just below the largest float32."""

LARGEST_FILE = (1 << 32) - 1
"""Bytes: the file's length is written in 32 bits."""


def write(path: Path, scene: Scene) -> None:
    """Write a scene as binary glTF.

    Args:
        path: The file; parent folders are made.
        scene: The scene, in this package's axes; written as float32.

    Raises:
        ArgumentError: a parameter is NaN, infinite, or beyond float32, a quaternion has zero length, or there are more
            Gaussians than the format's 4 GiB hold.
        OSError: it cannot be written. What stood there before is untouched.
    """
    gaussians = half_turned(scene.gaussians).map(torch.Tensor.float)
    gaussians.check_finite()
    attributes = _attributes(gaussians) if len(gaussians) else {}
    described = json.dumps(_description(scene, attributes), separators=(",", ":")).encode("ascii")
    described += b" " * (-len(described) % 4)
    size = sum(array.nbytes for array in attributes.values())  # a multiple of 4, as chunks have to be
    length = FILE_HEADER.size + CHUNK_HEADER.size + len(described) + (CHUNK_HEADER.size + size if size else 0)
    if length > LARGEST_FILE:
        raise ArgumentError(
            f"{path}: {len(gaussians):,} Gaussians are more than glTF's 4 GiB hold; write a .ply"
        )
    with written_aside(path) as aside, aside.open("wb") as file:
        file.write(FILE_HEADER.pack(b"glTF", 2, length))
        file.write(CHUNK_HEADER.pack(len(described), b"JSON") + described)
        if size:
            file.write(CHUNK_HEADER.pack(size, b"BIN\0"))
        for array in attributes.values():
            file.write(array.tobytes())


def _attributes(gaussians: Gaussians) -> dict[str, Float32[np.ndarray, "N C"]]:
    """Return the numbers of every attribute by its name."""
    raw = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    with np.errstate(over="ignore"):  # exp of a large number: the opacity is 0
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
    extras: dict[str, Any] = {}
    if scene.antialiased is not None:
        extras["antialiased"] = scene.antialiased
    if scene.up is not None:
        extras["up"] = [sign * x + 0.0 for sign, x in zip(POSITION_SIGNS, scene.up, strict=True)]  # no -0.0
    if extras:
        asset["extras"] = extras
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
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }

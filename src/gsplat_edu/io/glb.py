"""Binary glTF 2.0 with KHR_gaussian_splatting: the scene as a mesh of points, which glTF viewers can display.

All values are float32 and activated: linear scales, opacities in 0..1, quaternions (x, y, z, w) of length 1. They are
exact to float32, but logits above 17 and the length of a quaternion are lost. Scales above e^88, near the end of
float32, are clamped. SH coefficients have glTF's signs, which equal ours, one attribute per coefficient. Further
metadata is stored in the asset's extras: up, unit and origin as in `gsplat_edu.io.scene.extras`. A scene without
Gaussians is written without a mesh, because glTF has no empty meshes.

glTF's y points up. Scenes are converted by a half turn about x (`gsplat_edu.io.axes.half_turned`), as in SPZ: what
faced a camera that looks along our z then faces glTF's +z, its front. The half turn changes means, rotations and
harmonics. A scene with another up direction or an origin is turned and moved by its node's transform, in double, which
keeps the bits of the splats; a file of ours is read back into the scene's own coordinates. splat-transform turns about
z instead, so its files differ from ours by a half turn about y; they are recognised by their generator and turned back.

Files of any program are read as the extension says: splats of all nodes of the scene, with the nodes' transforms, as
float32 or the integers that the extension (and KHR_mesh_quantization for positions) allows, interleaved or not, and SPZ
in the file, by any draft of its extension (our tiles have the last one). Other primitives, other attributes and meshes
outside the scene are ignored. Transforms that splats cannot follow (shear, mirror, uneven scale), other kernels, linear
colours and other required extensions are refused by name.

Source: Khronos, "glTF 2.0 Specification" and the extension KHR_gaussian_splatting, in which scales are linear; drafts
before April 2026 had logarithms, which are refused where one is negative.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsplat_edu.io import glb_reading
from gsplat_edu.io.axes import half_turned, root_transform
from gsplat_edu.io.glb_container import EXTENSION, GENERATOR, root_node, write_container
from gsplat_edu.io.node_splats import Activated
from gsplat_edu.io.scene import Scene, extras
from gsplat_edu.scene.gaussians import Gaussians

POINTS, FLOAT, ARRAY_BUFFER = 0, 5126, 34962
"""Mode of a primitive; component type of an accessor; target of a buffer view."""

TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
"""Type of an accessor by its number of components."""


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
    values = Activated.of(gaussians)
    arrays = {
        "POSITION": values.means,
        f"{EXTENSION}:ROTATION": values.quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": values.scales,
        f"{EXTENSION}:OPACITY": values.opacities[:, None],
    }
    for degree in range(gaussians.sh_degree + 1):
        for order in range(2 * degree + 1):
            arrays[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = values.sh[:, degree**2 + order]
    return {name: array.astype("<f4") for name, array in arrays.items()}


def _description(scene: Scene, attributes: dict[str, Float32[np.ndarray, "N C"]]) -> dict[str, Any]:
    """Return the JSON: a scene of one node, one mesh, one primitive; a buffer view and an accessor per attribute."""
    asset: dict[str, Any] = {"version": "2.0", "generator": GENERATOR}
    known = extras(scene.frame)
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
    return glb_reading.read(path)

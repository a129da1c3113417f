"""Splats of formats that store activated values at nodes of a tree (glTF, USD): linear scales, opacities in 0 to 1.

Each node moves what it holds. A file of ours has one node, which turns the scene upright and moves it to its origin in
double (`gsplat_edu.io.axes.root_transform`); it is read back into the scene's own coordinates, with the same bits.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.axes import root_transform
from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.glb_container import refuse
from gsplat_edu.io.quantize import MIN_SCALE, unit_quats
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.frame import Vector
from gsplat_edu.scene.gaussians import Gaussians

LARGEST_LOG_SCALE = 88.0
"""exp of this is just below the largest float32."""

OPAQUE = 2.0**-24
"""Opacities are kept this far from 0 and 1 (half a float32 step at 1), so that their logits are finite."""

MOST_ENTRY = 1e30
"""Largest entry of a transform: the cube of a larger scale would overflow."""

SAME = 1e-12
"""Transforms that differ by less, relative and absolute, are the same: a quaternion rounds its rotation."""


class Activated(NamedTuple):
    """Values of N splats as a renderer takes them, in the axes of their node."""

    means: Float[np.ndarray, "N 3"]
    quats: Float[np.ndarray, "N 4"]  # w, x, y, z
    scales: Float[np.ndarray, "N 3"]
    opacities: Float[np.ndarray, " N"]
    sh: Float[np.ndarray, "N K 3"]

    @classmethod
    def of(cls, gaussians: Gaussians) -> Activated:
        """Return the values of Gaussians in float32, quaternions of length 1, scales at most e^88.

        Raises:
            ArgumentError: a quaternion has zero length.
        """
        raw = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
        with np.errstate(over="ignore"):  # exp overflows to infinity: the opacity is 0
            opacities = 1.0 / (1.0 + np.exp(-raw["logit_opacities"].astype(np.float64)))
        values = (
            raw["means"],
            unit_quats(raw["quats"]),
            np.exp(np.minimum(raw["log_scales"].astype(np.float64), LARGEST_LOG_SCALE)),
            opacities,
            np.concatenate([raw["sh0"], raw["sh_rest"]], axis=1),
        )
        return cls(*(value.astype(np.float32) for value in values))

    def gaussians(self, path: Path) -> Gaussians:
        """Return raw parameters in float32; scales and opacities are kept where their logarithms and logits are finite.

        Args:
            path: The file, for messages.

        Raises:
            SceneFormatError: a scale is negative, or an opacity lies outside 0 to 1.
        """
        scales, opacities = self.scales.astype(np.float64), self.opacities.astype(np.float64)
        if not ((scales >= 0).all() and ((opacities >= 0) & (opacities <= 1)).all()):
            refuse(path, "has a negative scale or an opacity outside 0 to 1")
        inside = np.clip(opacities, OPAQUE, 1.0 - OPAQUE)
        arrays = (
            self.means,
            self.quats,
            np.log(np.maximum(scales, MIN_SCALE)),
            self.sh[:, :1],
            self.sh[:, 1:],
            np.log(inside / (1.0 - inside)),
        )
        return Gaussians(
            *(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)) for array in arrays)
        )


def root_matrix(up: Vector | None, origin: Vector) -> Float64[np.ndarray, "4 4"]:
    """Return the transform of the root of a file of ours; see `gsplat_edu.io.axes.root_transform`."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = root_transform(up, origin)
    return matrix


def is_same(matrix: Float64[np.ndarray, "4 4"], root: Float64[np.ndarray, "4 4"]) -> bool:
    """Return whether two transforms are the same but for rounding."""
    return np.allclose(matrix, root, rtol=SAME, atol=SAME)


def moved(
    path: Path, own: Scene, matrix: Float64[np.ndarray, "4 4"], root: Float64[np.ndarray, "4 4"]
) -> Scene:
    """Return splats in the world's coordinates, or in the root's if their node has its transform.

    Args:
        path: The file, for messages.
        own: The splats in the coordinates of their node.
        matrix: From these to the world's, as a column vector is multiplied.
        root: Transform of the root of a file of ours.

    Raises:
        SceneFormatError: splats cannot follow the transform.
    """
    if not np.abs(matrix).max() <= MOST_ENTRY:
        refuse(path, "has a node whose transform is NaN, infinite or absurdly large")
    try:
        move = Similarity.of_matrix(matrix)
    except ArgumentError as error:
        fault = str(error).removeprefix("matrix: ").partition(";")[0]
        refuse(path, f"has a node whose transform {fault}; splats can be turned, scaled evenly and shifted")
    if is_same(matrix, root):
        return own
    scene = move.scene(own)
    if not all(bool(tensor.isfinite().all()) for tensor in scene.gaussians.tensors().values()):
        refuse(path, "has a node whose transform takes splats beyond float32")
    return scene

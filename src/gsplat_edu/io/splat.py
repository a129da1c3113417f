"""antimatter's .splat: 32 bytes per splat and nothing else.

Each splat has 3 float32 for the position, 3 float32 for the scales (linear), one byte each for red, green, blue and
opacity, and one byte each for the quaternion (w, x, y, z) as 128 q + 128. Little-endian. Colours are those of SH degree
0, C0 f_dc + 1/2 from 0 to 1; higher degrees are not stored. There is no header and no count: an empty file is a scene
without splats.

Axes are those of the scene: nothing is flipped.

Source: convert.py and main.js of antimatter15/splat (MIT licence).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.io.quantize import (
    MAX_SCALE,
    MIN_SCALE,
    byte_to_logit,
    logit_to_byte,
    rounded_bytes,
    unit_quats,
)
from gsplat_edu.io.scene import Scene
from gsplat_edu.scene.gaussians import Gaussians

SPLAT = np.dtype([("position", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def read(path: Path) -> Scene:
    """Read a .splat.

    Args:
        path: The file.

    Returns:
        The scene, float32, SH degree 0, in file order. A scale of 0 becomes `MIN_SCALE`, opacities are kept away from 0
        and 1, and a zero quaternion becomes the identity (1, 0, 0, 0), as in antimatter's viewer.

    Raises:
        SceneFormatError: the size is not a multiple of 32 bytes, a position is NaN or infinite, or a scale is NaN,
            infinite or negative.
        OSError: the file cannot be read.
    """
    stored = read_bytes(path)
    refuse_lfs_pointer(path, stored)
    if stored.startswith(b"ply"):
        raise SceneFormatError(f"{path}: is a PLY, not a .splat; rename it to .ply")
    if left := len(stored) % SPLAT.itemsize:
        raise SceneFormatError(
            f"{path}: is {len(stored)} bytes, {left} more than whole splats of {SPLAT.itemsize}; it is truncated or not"
            " a .splat, get it again"
        )
    splats = np.frombuffer(stored, dtype=SPLAT)
    _check(path, splats)
    quats = (splats["quat"].astype(np.float32) - 128.0) / 128.0
    quats[~quats.any(axis=1)] = (1.0, 0.0, 0.0, 0.0)
    colors = splats["rgba"][:, None, :3] / 255.0
    gaussians = Gaussians(
        means=torch.from_numpy(splats["position"].astype(np.float32)),
        quats=torch.from_numpy(quats),
        log_scales=torch.from_numpy(
            np.log(np.maximum(splats["scales"].astype(np.float64), MIN_SCALE)).astype(np.float32)
        ),
        sh0=torch.from_numpy(((colors - SH_OFFSET) / C0).astype(np.float32)),
        sh_rest=torch.zeros(len(splats), 0, 3),
        logit_opacities=torch.from_numpy(byte_to_logit(splats["rgba"][:, 3])),
    )
    return Scene(gaussians)


def write(path: Path, scene: Scene) -> None:
    """Write a .splat; SH coefficients above degree 0 are dropped.

    Splats are reordered by decreasing opacity times volume, as in antimatter's converter, so that viewers that have
    loaded only the beginning of the file show the most important ones. Both values are taken as stored; ties keep their
    order.

    Args:
        path: Output file; parent folders are created.
        scene: Quaternions are normalised, scales clamped to `MIN_SCALE` and `MAX_SCALE`, and colours clamped to 0..1.

    Raises:
        ArgumentError: a parameter is NaN or infinite in float32, or a quaternion has zero length.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    gaussians = scene.gaussians.map(torch.Tensor.float)
    gaussians.check_finite()
    tensors = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    splats = np.empty(len(gaussians), dtype=SPLAT)
    splats["position"] = tensors["means"]
    splats["scales"] = _scales(tensors["log_scales"])
    splats["rgba"][:, :3] = rounded_bytes((tensors["sh0"][:, 0].astype(np.float64) * C0 + SH_OFFSET) * 255.0)
    splats["rgba"][:, 3] = logit_to_byte(tensors["logit_opacities"])
    splats["quat"] = rounded_bytes(unit_quats(tensors["quats"]) * 128.0 + 128.0)
    with written_aside(path) as aside:
        aside.write_bytes(splats[_order(splats)].tobytes())


def _check(path: Path, splats: np.ndarray) -> None:
    scales = splats["scales"]
    for what, right in (
        ("position that is NaN or infinite", np.isfinite(splats["position"])),
        ("scale that is NaN, infinite or negative", np.isfinite(scales) & (scales >= 0.0)),
    ):
        if not right.all():
            bad = np.flatnonzero(~right.all(axis=1))
            raise SceneFormatError(
                f"{path}: splat {bad[0]} has a {what} ({len(bad)} such splats in all); it is damaged or not a .splat,"
                " get it again"
            )


def _scales(log_scales: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    low, high = np.log((MIN_SCALE, MAX_SCALE))
    scales: Float64[np.ndarray, "N 3"] = np.exp(np.clip(log_scales.astype(np.float64), low, high))
    return scales.astype(np.float32)


def _order(splats: np.ndarray) -> Int64[np.ndarray, " N"]:
    importance = splats["rgba"][:, 3] * np.prod(splats["scales"], axis=1, dtype=np.float64)
    return np.argsort(-importance, kind="stable")

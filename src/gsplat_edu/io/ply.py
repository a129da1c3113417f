"""Inria's scene PLY: the file that viewers of Gaussian splats read.

Binary little-endian float32, one vertex per Gaussian, raw values (logarithms of scales, logits of opacities):
x y z, nx ny nz (zero), f_dc_0..2, f_rest_* channel by channel, opacity, scale_0..2, rot_0..3 as (w, x, y, z).
A scene of SH degree 0 has no f_rest. Axes are those of the scene: nothing is flipped.

Source: the point_cloud.ply of Kerbl et al. 2023's code.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsplat_edu.files import written_aside
from gsplat_edu.gaussians import Gaussians


def save_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians as a scene PLY.

    Args:
        path: The file; parent folders are made.
        gaussians: N Gaussians, raw parameters; written as float32.

    Raises:
        ArgumentError: a parameter is NaN or infinite.
        OSError: the file cannot be written. What stood there before is untouched.
    """
    gaussians.check_finite()
    tensors = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    count = len(gaussians)
    sh_rest = np.concatenate(np.moveaxis(tensors["sh_rest"], 2, 0), axis=1)  # channel-major
    columns: list[tuple[list[str], np.ndarray]] = [
        (["x", "y", "z"], tensors["means"]),
        (["nx", "ny", "nz"], np.zeros((count, 3))),
        ([f"f_dc_{i}" for i in range(3)], tensors["sh0"][:, 0]),
        ([f"f_rest_{i}" for i in range(sh_rest.shape[1])], sh_rest),
        (["opacity"], tensors["logit_opacities"][:, None]),
        ([f"scale_{i}" for i in range(3)], tensors["log_scales"]),
        ([f"rot_{i}" for i in range(4)], tensors["quats"]),
    ]
    names = [name for group, _ in columns for name in group]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    table = np.concatenate([values for _, values in columns], axis=1).astype("<f4")
    with written_aside(Path(path)) as aside:
        aside.write_bytes("\n".join(header).encode("ascii") + table.tobytes())

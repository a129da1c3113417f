"""3D Gaussian Splatting that runs on the computer you have, explains itself, and gives the same answer twice.

The names here are the NumPy part of the system, as in the chapters. Training is in `gsplat_edu.train`, differentiable
rendering in `gsplat_edu.render.api`; those import torch, these do not.
"""

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, C0, C1, C2, C3, DILATION, T_STOP, TILE, Z_NEAR
from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError, ShapeError, SplatError
from gsplat_edu.render.numpy_reference import render_gaussians
from gsplat_edu.scene.camera import Camera, CameraLike, look_at, orbit_camera
from gsplat_edu.scene.gaussian_math import (
    build_cov3d,
    build_cov3d_batch,
    project_cov3d,
    quat_to_R,
    quat_to_R_batch,
)
from gsplat_edu.scene.sh import eval_sh, sh_basis
from gsplat_edu.scene.sphere_shell import sphere_shell

__version__ = "0.1.0"

__all__ = [
    "ALPHA_MAX",
    "ALPHA_MIN",
    "C0",
    "C1",
    "C2",
    "C3",
    "DILATION",
    "TILE",
    "T_STOP",
    "Z_NEAR",
    "ArgumentError",
    "BackendUnavailableError",
    "Camera",
    "CameraLike",
    "ShapeError",
    "SplatError",
    "build_cov3d",
    "build_cov3d_batch",
    "eval_sh",
    "look_at",
    "orbit_camera",
    "project_cov3d",
    "quat_to_R",
    "quat_to_R_batch",
    "render_gaussians",
    "sh_basis",
    "sphere_shell",
]

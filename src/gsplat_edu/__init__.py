"""3D Gaussian Splatting that runs on the computer you have, explains itself, and gives the same answer twice.

The names of the chapters are NumPy's part of the system. The others (`LAZY`) are torch's part, rendering and training;
they are imported on first use, so that importing the package does not import torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from gsplat_edu.base import pictures as _pictures
from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, C0, C1, C2, C3, DILATION, T_STOP, TILE, Z_NEAR
from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError, ShapeError, SplatError
from gsplat_edu.render.numpy_reference import render_gaussians
from gsplat_edu.scene.camera import Camera, CameraLike, look_at
from gsplat_edu.scene.gaussian_math import (
    build_cov3d,
    build_cov3d_batch,
    project_cov3d,
    quat_to_R,
    quat_to_R_batch,
)
from gsplat_edu.scene.rig import orbit_camera
from gsplat_edu.scene.sh import eval_sh, sh_basis
from gsplat_edu.scene.sphere_shell import sphere_shell

if TYPE_CHECKING:
    from gsplat_edu.data.dataset import load_dataset
    from gsplat_edu.io.formats import read_scene, write_scene
    from gsplat_edu.io.scene import Scene
    from gsplat_edu.render.api import render  # the package, which can be called
    from gsplat_edu.render.backends import load_backend
    from gsplat_edu.render.settings import RenderSettings
    from gsplat_edu.scene.gaussians import Gaussians
    from gsplat_edu.train.compose import training
    from gsplat_edu.train.config import recipe

__version__ = "0.1.0"

_pictures.scenes_shown_by("gsplat_edu.viewer.notebook")

LAZY = {
    "Gaussians": "scene.gaussians",
    "RenderSettings": "render.settings",
    "Scene": "io.scene",
    "load_backend": "render.backends",
    "load_dataset": "data.dataset",
    "read_scene": "io.formats",
    "recipe": "train.config",
    "training": "train.compose",
    "write_scene": "io.formats",
}
"""Names that are imported on first use, and their modules. `render`, the package, can be called as well."""

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
    "Gaussians",
    "RenderSettings",
    "Scene",
    "ShapeError",
    "SplatError",
    "build_cov3d",
    "build_cov3d_batch",
    "eval_sh",
    "load_backend",
    "load_dataset",
    "look_at",
    "orbit_camera",
    "project_cov3d",
    "quat_to_R",
    "quat_to_R_batch",
    "read_scene",
    "recipe",
    "render",
    "render_gaussians",
    "sh_basis",
    "sphere_shell",
    "training",
    "write_scene",
]


def __getattr__(name: str) -> object:
    if name not in LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{LAZY[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

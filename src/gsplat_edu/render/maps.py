"""Maps of a scene: accumulated alpha, depths, normals and distortion, from one render.

alpha = 1 - T, expected-depth = sum w z, depth = sum w z / alpha, planar-depth = sum w d / (sum w n . r),
normal = sum w n / |sum w n|, distortion = sum_{i<j} w_i w_j (z_i - z_j)²; `gsplat_edu.render.planes` defines d, n and r
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.ops.surface import planar_depth
from gsplat_edu.render.api import render
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.planes import PLANE_CHANNELS, distortion_features, facing_normals, plane_features
from gsplat_edu.render.settings import MAPS, RenderSettings
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussians import Gaussians


def render_maps(
    gaussians: Gaussians,
    camera: CameraLike,
    names: Sequence[str],
    settings: RenderSettings | None = None,
    backend: str = "auto",
) -> tuple[dict[str, Tensor], RenderOutput]:
    """Render maps from one camera, in one pass.

    Args:
        gaussians: N Gaussians.
        camera: A `Camera` or any object with its members.
        names: Which maps:
            "alpha": (H, W) accumulated alpha, 0 to 1. Differentiable.
            "expected-depth": (H, W) sum of w z, world units; not divided by alpha. Differentiable.
            "depth": (H, W) the same divided by alpha, 0 where nothing is. Differentiable.
            "median-depth": (H, W) depth of the Gaussian at which the transmittance falls below one half, world units,
            0 where it does not. It has no gradient.
            "planar-depth": (H, W) depth of the composited plane, world units: exact where all Gaussians of a pixel lie
            in one plane; 0 where nothing is, or where the plane is seen edge-on. Differentiable.
            "normal": (H, W, 3) composited `facing_normals` of unit length, world axes, 0 where nothing is.
            Differentiable; see there what is constant.
            "distortion": (H, W) how far the Gaussians of a pixel lie apart in depth, world units squared.
            Differentiable.
        settings: Render settings; depths are rendered as the names need them. None uses the defaults.
        backend: As for `render`.

    Returns:
        The maps by name, and the view itself.

    Raises:
        ArgumentError: a name is unknown, or as for `render`.
    """
    if unknown := [name for name in names if name not in MAPS]:
        raise ArgumentError(f"maps: does not know {unknown[0]!r}; use {', '.join(MAPS)}")
    one: Camera = as_camera("camera", camera)
    settings = replace(
        settings or RenderSettings(),
        depth="depth" in names or "expected-depth" in names,
        median_depth="median-depth" in names,
    )
    parts = []
    if "planar-depth" in names:
        parts.append(plane_features(gaussians, one))
    elif "normal" in names:
        parts.append(facing_normals(gaussians, one))
    if "distortion" in names:
        parts.append(distortion_features(gaussians, one))
    view = render(
        gaussians,
        one,
        settings=settings,
        features=torch.cat(parts, dim=1) if parts else None,
        backend=backend,
    )
    return {name: _map(view, one, name) for name in names}, view


def _map(view: RenderOutput, camera: Camera, name: str) -> Tensor:
    if name == "alpha":
        return view.alpha
    if name == "depth":
        return view.mean_depth
    images = {"expected-depth": view.depth, "median-depth": view.median_depth}
    found = images.get(name, view.features)
    assert found is not None, "render_maps asks for what the names need"
    if name == "normal":
        return _unit(found[..., :3])
    if name == "planar-depth":
        rays = torch.from_numpy(camera.rays()).to(found)
        return planar_depth(found[..., :PLANE_CHANNELS], rays)
    if name == "distortion":
        first, second = found[..., -2], found[..., -1]
        return view.alpha * second - first * first
    return found


def _unit(vectors: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Return vectors of unit length; the zero vector stays, with a gradient of zero."""
    squared = (vectors * vectors).sum(dim=-1, keepdim=True)
    # where() twice keeps the square root's infinite slope at 0 out of the chain rule.
    return torch.where(squared > 0, vectors / torch.where(squared > 0, squared, 1.0).sqrt(), 0.0)

"""Maps of a scene: accumulated alpha, depths and normals, each from one render.

alpha = 1 - T, expected-depth = sum w z, depth = sum w z / alpha, normal = sum w n / |sum w n|
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.render.api import render
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import MAPS, RenderSettings
from gsplat_edu.scene.camera import Camera, CameraLike, as_camera
from gsplat_edu.scene.gaussians import Gaussians, unchecked_rotations


def facing_normals(gaussians: Gaussians, camera: CameraLike) -> Float[Tensor, "N 3"]:
    """Return each Gaussian's shortest axis, turned towards the camera. For a sphere it is one of three arbitrary ones.

    Args:
        gaussians: N Gaussians.
        camera: A `Camera` or any object with its members.

    Returns:
        (N, 3) unit vectors in world axes; zero for a Gaussian whose rotation is undefined.

    Raises:
        ArgumentError: `camera` is invalid.

    Differentiable in: quats. Which axis is the shortest, and its sign, are constants.
    """
    eye = torch.tensor(as_camera("camera", camera).eye).to(gaussians.means)
    shortest = gaussians.log_scales.detach().argmin(dim=-1)
    rotations = unchecked_rotations(gaussians.quats)
    axes = rotations.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    axes = axes.where(axes.detach().isfinite(), 0.0)
    away = ((gaussians.means - eye) * axes).sum(dim=-1, keepdim=True).detach() > 0
    return torch.where(away, -axes, axes)


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
            "normal": (H, W, 3) composited `facing_normals` of unit length, world axes, 0 where nothing is.
            Differentiable; see there what is constant.
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
    features = facing_normals(gaussians, one) if "normal" in names else None
    view = render(gaussians, one, settings=settings, features=features, backend=backend)
    return {name: _map(view, name) for name in names}, view


def _map(view: RenderOutput, name: str) -> Tensor:
    found: Tensor | None
    if name == "alpha":
        found = view.alpha
    elif name == "depth":
        found = view.mean_depth
    else:
        images = {"expected-depth": view.depth, "median-depth": view.median_depth, "normal": view.features}
        found = images[name]
    assert found is not None, "render_maps asks for what the names need"
    return _unit(found) if name == "normal" else found


def _unit(vectors: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Return vectors of unit length; the zero vector stays, with a gradient of zero."""
    squared = (vectors * vectors).sum(dim=-1, keepdim=True)
    # where() twice keeps the square root's infinite slope at 0 out of the chain rule.
    return torch.where(squared > 0, vectors / torch.where(squared > 0, squared, 1.0).sqrt(), 0.0)

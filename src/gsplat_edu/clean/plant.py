"""Plant floaters in a scene, to measure how many of them cleaning finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians

NEAREST, FARTHEST = 0.3, 0.8
"""Range of a floater's depth, as a fraction of the depth of the surface behind it."""

GROWTH = 3.0
"""Half of the floaters are larger than the splat they are made from, by up to this factor."""

FAINTEST, STRONGEST = 0.1, 0.9
"""Range of the opacities of the floaters that do not have that of the splat they are made from: half of them."""


def floaters(
    gaussians: Gaussians, cameras: Sequence[Camera], settings: RenderSettings, count: int, seed: int = 0
) -> Gaussians:
    """Make floaters in the free space between the cameras and what they see.

    Each lies on the ray of a random pixel of a random camera, and looks from there as large as a random splat that
    this camera sees. Its shape and opacity are those of that splat, except that half of the floaters are up to three
    times as large, and half have a random opacity. Its colour is that of another random splat.

    Args:
        gaussians: N Gaussians on the CPU.
        cameras: Cameras of the capture.
        settings: The scene's render settings.
        count: Number of floaters.
        seed: Seed of every random draw.

    Returns:
        `count` Gaussians, with the SH degree of the scene.

    Raises:
        ArgumentError: `count` is below 1, or no camera sees anything.
    """
    whole_number("count", count, 1)
    rng = np.random.default_rng(seed)
    share = -(-count // max(len(cameras), 1))
    settings = replace(settings, depth=False, median_depth=True)
    made = [found for camera in cameras if (found := _seen_from(gaussians, camera, settings, share, rng))]
    if not made:
        raise ArgumentError("cameras: none of them sees anything")
    means, rows, grown = (np.concatenate(part) for part in zip(*made, strict=True))
    chosen = (
        rng.permutation(len(means))[:count] if len(means) >= count else rng.integers(len(means), size=count)
    )
    shape = torch.from_numpy(rows[chosen])
    color = torch.from_numpy(rng.integers(len(gaussians), size=count))
    larger = grown[chosen] * np.where(rng.random(count) < 0.5, 1.0, rng.uniform(1.0, GROWTH, count))
    opacity = rng.uniform(FAINTEST, STRONGEST, count)
    logits = torch.from_numpy(np.log(opacity / (1.0 - opacity))).to(gaussians.means)
    own = torch.from_numpy(rng.random(count) < 0.5)
    return Gaussians(
        means=torch.from_numpy(means[chosen]).to(gaussians.means),
        quats=gaussians.quats[shape],
        log_scales=gaussians.log_scales[shape]
        + torch.from_numpy(np.log(larger)).to(gaussians.means)[:, None],
        sh0=gaussians.sh0[color],
        sh_rest=gaussians.sh_rest[color],
        logit_opacities=torch.where(own, gaussians.logit_opacities[shape], logits),
    )


def _seen_from(
    gaussians: Gaussians, camera: Camera, settings: RenderSettings, count: int, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "C 3"], Int64[np.ndarray, " C"], Float64[np.ndarray, " C"]] | None:
    """Return positions, splats to resemble, and factors of their scales; None if the camera sees nothing."""
    with torch.no_grad():
        view = render(gaussians, camera, settings=settings, backend="cpu")
    assert view.median_depth is not None
    depth = view.median_depth.double().numpy()
    visible = view.visible.numpy()[view.radii.numpy().max(axis=1, initial=0.0) >= 1.0]
    v, u = np.nonzero(depth > 0)
    if not len(v) or not len(visible):
        return None
    pixel = rng.integers(len(v), size=count)
    v, u = v[pixel], u[pixel]
    z = depth[v, u] * rng.uniform(NEAREST, FARTHEST, count)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(count)], axis=1)
    rows = visible[rng.integers(len(visible), size=count)]
    distance = (gaussians.means.double().numpy()[rows] - camera.eye) @ camera.R[2]
    return (z[:, None] * rays) @ camera.R + camera.eye, rows, z / distance

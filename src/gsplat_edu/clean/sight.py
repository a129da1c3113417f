"""Count for each splat of a scene how many cameras see it.

With w = T alpha, the weight of a splat in a pixel (T: transmittance in front of it), a camera sees the splat if

    w >= SEEN opacity   in any pixel.

alpha is at most the opacity, so T is then at least `SEEN` in that pixel. A splat at the surface passes; one behind an
opaque surface does not. Photos are not read, so their masks do not count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float64, Int32, Int64

from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians

SEEN = 0.1
"""Least weight of a visible splat in some pixel, as a fraction of its opacity."""


def largest_weights(
    gaussians: Gaussians, camera: Camera, settings: RenderSettings, backend: Backend
) -> tuple[Int64[np.ndarray, " M"], Float[np.ndarray, " M"]]:
    """Return the indices of the splats that take part in an image, and the largest weight of each in any pixel.

    Args:
        gaussians: N Gaussians on the CPU.
        camera: The camera, through any lens.
        settings: The scene's render settings.
        backend: What renders; it has to collect statistics (`gsplat_edu.clean.evidence.judging_backend`).
    """
    ids, found = _weights(gaussians, camera, settings, backend, "weight_max")
    return ids, found["weight_max"]


def visible_weights(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    settings: RenderSettings,
    backend: Backend,
    progress: Callable[[], object] = lambda: None,
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    """Return the sum of each splat's weights over all pixels of all cameras, (N,), and the largest of them, (N,).

    Args:
        gaussians: N Gaussians on the CPU.
        cameras: The cameras, through any lens.
        settings: The scene's render settings.
        backend: As for `largest_weights`.
        progress: Called after every camera.
    """
    total, largest = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for camera in cameras:
        ids, found = _weights(gaussians, camera, settings, backend, "weight_sum", "weight_max")
        total[ids] += found["weight_sum"]
        largest[ids] = np.maximum(largest[ids], found["weight_max"])
        progress()
    return total, largest


def _weights(
    gaussians: Gaussians, camera: Camera, settings: RenderSettings, backend: Backend, *names: str
) -> tuple[Int64[np.ndarray, " M"], dict[str, Float[np.ndarray, " M"]]]:
    some = replace(gaussians, logit_opacities=gaussians.logit_opacities.detach().clone().requires_grad_())
    output = render(some, camera, settings=settings, backend=backend)
    weights = output.collect(*names)
    torch.autograd.grad(output.image, some.logit_opacities, torch.zeros_like(output.image))
    return output.visible.numpy(), {name: found.numpy() for name, found in weights().items()}


def times_seen(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    settings: RenderSettings,
    backend: Backend,
    progress: Callable[[], object] = lambda: None,
) -> Int32[np.ndarray, " N"]:
    """Return how many cameras see each of N splats; one forward and one backward pass per camera.

    Args:
        gaussians: N Gaussians on the CPU.
        cameras: The cameras, through any lens.
        settings: The scene's render settings.
        backend: As for `largest_weights`.
        progress: Called after every camera.
    """
    count: Int32[np.ndarray, " N"] = np.zeros(len(gaussians), dtype=np.int32)
    least = SEEN * gaussians.opacities.detach().numpy()
    for camera in cameras:
        ids, weights = largest_weights(gaussians, camera, settings, backend)
        count[ids] += (weights > 0) & (weights >= least[ids])
        progress()
    return count

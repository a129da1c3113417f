"""Fit the opacities of all doubtful splats of a scene to the photos together.

The gain of a splat (`gsplat_edu.clean.evidence`) assumes that all others stay. If several splats can fill one hole,
each seems necessary while all are removed, and none while all are present. Each doubtful splat therefore gets a factor
f on its opacity, and Adam fits all factors together, one view per step:

    minimise  sum over views of the squared error  +  price * sum of f,    0 < f < 1.

The price removes splats that do not change the photos.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, Int64

from gsplat_edu.clean.evidence import MOST_OPAQUE, judged_over, residual_of
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.views import View

RATE = 0.25
"""Adam's step, in logits of a factor."""

BETAS = (0.9, 0.99)
"""Decay of Adam's two moments."""

SLOW_PART = 0.5
"""In this last fraction of the steps the rate is a third."""

Progress = Callable[[], None]
"""Called after every step."""


@dataclass(frozen=True, eq=False)
class Doubtful:
    """Splats to judge.

    Args:
        ids: (D,) their indices.
        start: (D,) logits of their factors to start from.
        price: Remove a splat if that adds less than this squared error per view, in multiples of `unit` of `settle`.
    """

    ids: Int64[np.ndarray, " D"]
    start: Float64[np.ndarray, " D"]
    price: float


class Judged(NamedTuple):
    """A photo, its camera, and the settings of the render that it is compared with."""

    camera: Camera
    photo: Photo
    settings: RenderSettings


def settle(
    gaussians: Gaussians,
    doubtful: Doubtful,
    views: Sequence[View],
    settings: RenderSettings,
    backend: Backend,
    unit: float,
    steps: int,
    progress: Progress = lambda: None,
) -> Float64[np.ndarray, " D"]:
    """Fit the factors of the doubtful splats.

    Args:
        gaussians: N Gaussians on the CPU.
        doubtful: The doubtful splats, D of them.
        views: Cameras and photos; each pass takes them in a new random order, always the same one.
        settings: The scene's render settings.
        backend: What renders.
        unit: Average squared error per splat and view. It is added to Adam's denominator, so that gradients far below
            it, the price's included, hardly move a factor.
        steps: Number of steps.
        progress: Called after every step.

    Returns:
        (D,) logits of the factors; a negative one means that the splat can be removed.

    Raises:
        DatasetError: a photo cannot be read.
    """
    rng = np.random.default_rng(0)
    logits = doubtful.start.copy()
    first, second = np.zeros_like(logits), np.zeros_like(logits)
    order: list[int] = []
    for step in range(1, steps + 1):
        order = order or rng.permutation(len(views)).tolist()
        index = order.pop()
        photo = views[index].read()
        shown = Judged(views[index].camera, photo, judged_over(photo, settings, index))
        slope = logit_gradient(gaussians, doubtful, logits, shown, backend, unit)
        first += (1.0 - BETAS[0]) * (slope - first)
        second += (1.0 - BETAS[1]) * (np.square(slope) - second)
        rate = RATE if step <= (1.0 - SLOW_PART) * steps else RATE / 3.0
        spread = np.sqrt(second / (1.0 - BETAS[1] ** step)) + unit
        logits -= rate * first / (1.0 - BETAS[0] ** step) / spread
        progress()
    return logits


def logit_gradient(
    gaussians: Gaussians,
    doubtful: Doubtful,
    logits: Float64[np.ndarray, " D"],
    view: Judged,
    backend: Backend,
    unit: float,
) -> Float64[np.ndarray, " D"]:
    """Return the gradient of one view's summand with respect to the logits of the factors."""
    factor = 1.0 / (1.0 + np.exp(-logits))
    opacity = np.minimum(gaussians.opacities.double().numpy(), MOST_OPAQUE)
    opacity[doubtful.ids] *= factor
    shown = torch.from_numpy(np.log(opacity / (1.0 - opacity))).to(gaussians.means).requires_grad_()
    output = render(
        replace(gaussians, logit_opacities=shown), view.camera, settings=view.settings, backend=backend
    )
    residual, _ = residual_of(output, view.photo, view.settings)
    (found,) = torch.autograd.grad(output.image, shown, 2.0 * residual)
    # d logit(f o) = (1 - f) / (1 - f o) d logit(f)
    chain = (1.0 - factor) / (1.0 - opacity[doubtful.ids])
    photo: Float64[np.ndarray, " D"] = found.double().numpy()[doubtful.ids] * chain
    slope: Float64[np.ndarray, " D"] = photo + doubtful.price * unit * factor * (1.0 - factor)
    return slope

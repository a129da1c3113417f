"""Measure for each splat of a scene how much better the capture's photos fit without it.

In one view, w is the weight (alpha times transmittance) of a splat in a pixel, z the splat's depth, D the median depth
of the scene there, I the render and P the photo. Without the splat, the pixel changes by

    d = -alpha dI/dalpha = w (behind - color),

exactly, because a pixel is linear in the alpha of each splat. Its squared error therefore changes by 2 (I - P) d + d².
Summed over pixels, the first term follows from the gradient of the squared error in the splat's opacity. The second is
the mean of (sum of s d)² over random signs s; one draw per view suffices, because many views are added. Two backward
passes per view thus measure this for every splat at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from gsplat_edu.clean.sight import largest_weights
from gsplat_edu.evaluate.metrics import BEHIND_ALPHA
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.views import View

MOST_OPAQUE = 0.985
"""Upper bound of opacities during the measurement. It is below the clamp of alpha, so that every pixel has a
gradient."""

FAINT = 0.02
"""Opacity at which a removed splat is rendered again: it hides nothing, and its core still exceeds 1/255."""

REDRAWN_EVERY = 4
"""Render a removed splat again in one of this many views, so that few removed splats overlap."""

Progress = Callable[[], None]
"""Called after every view."""


def judging_backend(backend: Backend | None) -> Backend:
    """Return the backend that renders a judgement, `cpu` if none is given.

    Args:
        backend: A backend that collects the statistics of each splat.

    Raises:
        ArgumentError: it does not collect them.
    """
    backend = load_backend("cpu") if backend is None else backend
    backend.require("statistics", "clean:")
    return backend


@dataclass(frozen=True, eq=False)
class Evidence:
    """Sums over the views, for N splats.

    Args:
        weight: (N,) sum of w over all pixels.
        peak: (N,) largest w in any pixel, masked ones included.
        gap: (N,) mean of 1 - z/D, weighted by w: distance of the splat in front of the visible surface, as a fraction
            of D; negative behind the surface. Pixels that are masked or see nothing solid add 0.
        gain: (N,) squared error of the photos with the splat minus the error without it, all other splats unchanged.
        spread: (N,) sum over the views of the squared contribution to `gain`.
        views: (N,) number of views in which the splat has a weight in a pixel that adds to `gap`.
        error: Squared error of all photos, summed over pixels and channels.
    """

    weight: Float64[np.ndarray, " N"]
    peak: Float32[np.ndarray, " N"]
    gap: Float64[np.ndarray, " N"]
    gain: Float64[np.ndarray, " N"]
    spread: Float64[np.ndarray, " N"]
    views: np.ndarray
    error: float


def gather(
    gaussians: Gaussians,
    views: Sequence[View],
    settings: RenderSettings,
    backend: Backend,
    removed: Bool[np.ndarray, " N"] | None = None,
    progress: Progress = lambda: None,
) -> Evidence:
    """Measure every splat in the capture's views; two backward passes per view.

    Args:
        gaussians: N Gaussians on the CPU.
        views: Cameras and photos.
        settings: The scene's render settings.
        backend: What renders; it has to collect statistics (`judging_backend`).
        removed: (N,) splats that are removed already: they are drawn faintly, each in a quarter of the views, and
            their `gain` is scaled to their own opacity. None for none.
        progress: Called after every view.

    Raises:
        DatasetError: a photo cannot be read.
    """
    count = len(gaussians)
    sums = _Sums(count, backend)
    gone = np.zeros(count, dtype=bool) if removed is None else removed
    ids = np.arange(count)
    for index, view in enumerate(views):
        drawn = ~gone if not gone.any() else ~gone | ((ids + index) % REDRAWN_EVERY == 0)
        sums.add(gaussians, np.flatnonzero(drawn), gone, view, settings, index)
        progress()
    return sums.evidence()


def peak_weights(
    gaussians: Gaussians, views: Sequence[View], settings: RenderSettings, backend: Backend
) -> Float32[np.ndarray, " N"]:
    """Return the largest weight of each splat in any pixel of any view; photos are not read.

    Args:
        gaussians: N Gaussians on the CPU.
        views: The cameras.
        settings: The scene's render settings.
        backend: What renders; it has to collect statistics (`judging_backend`).
    """
    found: Float32[np.ndarray, " N"] = np.zeros(len(gaussians), dtype=np.float32)
    for view in views:
        ids, weights = largest_weights(gaussians, view.camera, settings, backend)
        found[ids] = np.maximum(found[ids], weights)
    return found


def judged_over(photo: Photo, settings: RenderSettings, index: int) -> RenderSettings:
    """Return the settings that a photo is judged with: if it has alpha, over black in some views, over white in others.

    Over one colour, no photo would refute splats of that colour outside of what the photos cut out. The colour changes
    after `REDRAWN_EVERY` views, so that each removed splat is rendered again over both.

    Args:
        photo: The photo.
        settings: The scene's render settings.
        index: Number of the view.
    """
    if photo.alpha is None:
        return settings
    return replace(settings, background=BEHIND_ALPHA[index // REDRAWN_EVERY % len(BEHIND_ALPHA)])


def residual_of(
    output: RenderOutput, photo: Photo, settings: RenderSettings
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Return the render minus the photo, and which pixels count.

    Args:
        output: A render of the view's camera.
        photo: The view's photo.
        settings: The settings of the render; photos that are not opaque are seen over its background.

    Returns:
        (H, W, 3) the difference, 0 where the pixel does not count, and (H, W) 1 where it counts.
    """
    image = output.image.detach().clamp(0.0, 1.0)
    counts = torch.ones_like(output.transmittance)
    if photo.mask is not None:
        counts = torch.from_numpy(photo.mask).to(counts)
    truth = photo.over(settings.background)
    difference = image - torch.from_numpy(truth).to(image) / (255.0 if truth.dtype == np.uint8 else 1.0)
    return difference * counts[..., None], counts


class _Sums:
    """Running sums of the evidence."""

    def __init__(self, count: int, backend: Backend) -> None:
        self._backend = backend
        self.weight, self.near, self.gain, self.spread = (np.zeros(count) for _ in range(4))
        self.peak: Float32[np.ndarray, " N"] = np.zeros(count, dtype=np.float32)
        self.views = np.zeros(count, dtype=np.int32)
        self.error = 0.0

    def evidence(self) -> Evidence:
        gap = np.divide(self.near, self.weight, out=np.zeros_like(self.near), where=self.weight > 0)
        return Evidence(self.weight, self.peak, gap, self.gain, self.spread, self.views, self.error)

    def add(
        self,
        gaussians: Gaussians,
        drawn: Int64[np.ndarray, " M"],
        gone: Bool[np.ndarray, " N"],
        view: View,
        settings: RenderSettings,
        index: int,
    ) -> None:
        """Add the evidence of one view for the splats `drawn`. Those in `gone` are rendered faintly."""
        rows = torch.from_numpy(drawn)
        some = gaussians if len(drawn) == len(gaussians) else gaussians.map(lambda tensor: tensor[rows])
        full = np.minimum(some.opacities.double().numpy(), MOST_OPAQUE)
        shown = np.where(gone[drawn], np.minimum(full, FAINT), full)
        logits = torch.from_numpy(np.log(shown / (1.0 - shown))).to(some.means).requires_grad_()
        photo = view.read()
        over = judged_over(photo, settings, index)
        output = render(
            replace(some, logit_opacities=logits), view.camera, settings=over, backend=self._backend
        )
        residual, counts = residual_of(output, photo, over)
        self.error += float(np.square(residual.double().numpy()).sum())
        signs = np.random.default_rng(index).integers(0, 2, output.image.shape, dtype=np.int8)
        inverse = counts * _inverse_depth(output)
        weight = output.collect("error_sum", "weight_sum", "weight_max", errors=(inverse > 0).to(counts))
        second = _gradient(output, logits, torch.from_numpy(2 * signs - 1).to(residual) * counts[..., None])
        weight_of = weight()
        near = output.collect("error_sum", errors=inverse)
        first = _gradient(output, logits, 2.0 * residual)
        near_of = near()
        change, square = -first / (1.0 - shown), np.square(second / (1.0 - shown))
        scale = full / shown
        gain = (scale * scale - 2.0 * scale) * square - scale * change
        self.gain[drawn] += gain
        self.spread[drawn] += np.square(gain)
        ids = drawn[output.visible.numpy()]
        z = (gaussians.means[torch.from_numpy(ids)].double().numpy() - view.camera.eye) @ view.camera.R[2]
        w = weight_of["error_sum"].double().numpy()
        self.weight[ids] += weight_of["weight_sum"].double().numpy()
        self.near[ids] += w - z * near_of["error_sum"].double().numpy()
        self.peak[ids] = np.maximum(self.peak[ids], weight_of["weight_max"].numpy())
        self.views[ids] += w > 0.0


def _inverse_depth(output: RenderOutput) -> Float[Tensor, "H W"]:
    """Return 1 / median depth; 0 where the view sees nothing solid."""
    depth = output.median_depth
    assert depth is not None, "gather asks for it"
    return torch.where(depth > 0, 1.0 / torch.where(depth > 0, depth, 1.0), 0.0)


def _gradient(output: RenderOutput, logits: Tensor, image: Tensor) -> Float64[np.ndarray, " M"]:
    """Return the gradient in the logits of the sum of the image times `image`."""
    (found,) = torch.autograd.grad(output.image, logits, image, retain_graph=True)
    gradient: Float64[np.ndarray, " M"] = found.double().numpy()
    return gradient

"""Find what was in front of the camera in one photo and not in the others, from the residuals of a scene.

e_v(p): norm of the smoothed difference of photo v and its render, at pixel p
r_s:    for splat s, a quantile over the views of its mean residual  (sum of w e_v) / (sum of w)
E_v(p): mean r_s of the splats that pixel p shows, weighted by w

E is the error expected from the other views. It is large where the scene is unfinished, shiny or too detailed, because
many views are wrong there. A pixel is masked where e exceeds several times E: an object that was present in a few
photos causes errors in these photos only.

Sums are those of NumPy, SciPy and the renderer, so the masks have the same bits for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, Int64, UInt16
from scipy import ndimage
from torch import Tensor

from gsplat_edu.base.threads import one_thread
from gsplat_edu.ops.exposure import color_matrix, measured_gains
from gsplat_edu.ops.recolor import Backdrop, recolored
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View

SMOOTH = 0.008
"""Sigma of the smoothing, as a fraction of the photo's diagonal."""

RULES = ((0.9, 3.0, 0.1), (0.5, 4.0, 0.2))
"""Each rule: quantile over the views, factor, floor. A pixel stands out if e > factor E + floor for one of the rules;
colours range from 0 to 1. The first rule finds faint objects that hide a place in fewer than a tenth of the views; with
the median it would also mask highlights, which neighbouring views share. The second finds differences larger than those
of highlights, even if objects hide a place in up to half of the views."""

GROW = 0.7
"""A mask grows from pixels that stand out to connected pixels whose error exceeds this fraction of the limit."""

SMALLEST = 0.0015
"""Spots smaller than this share of a photo are not masked."""

MARGIN = 0.008
"""Masks are widened by this, as a fraction of the photo's diagonal."""

LARGEST_SHARE = 0.4
"""Do not mask a photo if more than this fraction would be masked: something else is wrong, for example its pose."""

FEWEST_OTHERS = 3
"""A splat has a base if it shows in at least this many other views."""

BASED = 0.5
"""Only pixels with at least this weight of splats with a base can be masked."""

LEAST_WEIGHT = 0.1
"""A splat shows in a view if its weights there add up to this, px."""

BINS = 40
"""Residuals are counted in this many bins."""

AT_ONCE = 1 << 16
"""Number of splats whose quantiles are computed at once."""

_EDGES = np.geomspace(0.004, 0.6, BINS - 1).astype(np.float32)
_VALUES = np.concatenate([_EDGES[:1], np.sqrt(_EDGES[1:] * _EDGES[:-1]), _EDGES[-1:]])


@runtime_checkable
class FeatureRenderer(Protocol):
    """Renders Gaussians with features, differentiably in these; see `gsplat_edu.render.api.render`."""

    def __call__(
        self,
        gaussians: Gaussians,
        camera: Camera | CameraTensors,
        *,
        settings: RenderSettings,
        features: Tensor,
    ) -> RenderOutput:
        """Render."""
        ...


@dataclass(frozen=True)
class Compared:
    """How photos are compared with the scene.

    Args:
        render: The renderer.
        settings: Its settings.
        camera: Returns the camera of a view, from its index and its camera at the size that is compared.
    """

    render: FeatureRenderer
    settings: RenderSettings
    camera: Callable[[int, Camera], Camera | CameraTensors]


@dataclass(frozen=True, eq=False)
class Found:
    """What one view shows that others do not.

    Args:
        mask: (H, W) true for these pixels; all false for a view that is left alone.
        too_large: Whether the view is left alone because more than `LARGEST_SHARE` of it would be masked.
    """

    mask: Bool[np.ndarray, "H W"]
    too_large: bool


def find_masks(gaussians: Gaussians, views: Sequence[View], how: Compared) -> list[Found]:
    """Find in each view which pixels show what other views do not.

    Args:
        gaussians: The scene.
        views: The views, already at the size at which they are compared.
        how: Renderer, settings and cameras.

    Returns:
        One mask per view, of its size.

    Raises:
        DatasetError: a photo cannot be read.
    """
    with torch.no_grad():
        return _found(gaussians, views, how)


def _found(gaussians: Gaussians, views: Sequence[View], how: Compared) -> list[Found]:
    counts = np.zeros((len(gaussians), BINS), dtype=np.uint16)
    errors: list[Float16[np.ndarray, "_ _"]] = []
    for index, view in enumerate(views):
        error, shown, means = _residual(gaussians, index, view, how)
        errors.append(error.astype(np.float16))
        counts[shown, np.searchsorted(_EDGES, means)] += 1
    usual, base = _expected(counts)
    planes = np.concatenate([usual * base[:, None], base[:, None]], axis=1)
    features = torch.from_numpy(planes).to(gaussians.means)
    found = []
    for index, (view, kept) in enumerate(zip(views, errors, strict=True)):
        output = how.render(
            gaussians, how.camera(index, view.camera), settings=how.settings, features=features
        )
        assert output.features is not None, "features were given"
        shown_by = output.features.float().numpy(force=True)
        found.append(outstanding(kept.astype(np.float32), shown_by[..., :-1], shown_by[..., -1]))
    return found


def outstanding(
    error: Float32[np.ndarray, "H W"],
    expected: Float32[np.ndarray, "H W rules"],
    based: Float32[np.ndarray, "H W"],
) -> Found:
    """Find spots whose errors are far above the expected ones, and widen them.

    Args:
        error: (H, W) e, NaN for pixels that do not count.
        expected: (H, W, rules) sum of w r over the splats with a base, for each of `RULES`.
        based: (H, W) sum of w over these splats.
    """
    known = based > BASED
    usual = expected / np.where(known, based, 1.0)[..., None]
    limit = np.min([k * usual[..., i] + floor for i, (_, k, floor) in enumerate(RULES)], axis=0)
    ratio = np.where(known, np.nan_to_num(error, nan=0.0) / limit, 0.0)
    spots, count = ndimage.label(ratio > GROW)
    numbers = np.arange(count + 1)
    least = max(SMALLEST * error.size, 1.0)
    chosen = ndimage.sum_labels(ratio > GROW, spots, numbers) >= least
    chosen &= 2.0 * ndimage.sum_labels(ratio > 1.0, spots, numbers) >= least
    chosen[0] = False
    mask: Bool[np.ndarray, "H W"] = chosen[spots]
    if mask.any():
        reach = max(MARGIN * float(np.hypot(*error.shape)), 1.0)
        mask = ndimage.distance_transform_edt(~mask) <= reach
    too_large = bool(mask.mean() > LARGEST_SHARE)
    return Found(np.zeros_like(mask) if too_large else mask, too_large)


def smoothed_difference(
    image: Float32[np.ndarray, "H W 3"],
    photo: Float32[np.ndarray, "H W 3"],
    counts: Bool[np.ndarray, "H W"] | None,
) -> Float32[np.ndarray, "H W"]:
    """Return the norm of the smoothed difference of two images, per pixel; NaN where no pixel around counts.

    The difference keeps its sign while it is smoothed, so that detail that the scene cannot show yet cancels.
    """
    sigma = SMOOTH * float(np.hypot(*image.shape[:2]))
    weight = np.ones(image.shape[:2], np.float32) if counts is None else counts.astype(np.float32)
    total = ndimage.gaussian_filter(weight, sigma, mode="nearest", truncate=3.0)
    difference = (image - photo) * weight[..., None]
    soft = np.stack(
        [ndimage.gaussian_filter(difference[..., c], sigma, mode="nearest", truncate=3.0) for c in range(3)],
        axis=-1,
    )
    error = np.sqrt(np.mean(np.square(soft), axis=-1)) / np.maximum(total, 1e-3)
    error[(weight == 0) | (total < 0.05)] = np.nan
    return np.asarray(error, dtype=np.float32)


def _residual(
    gaussians: Gaussians, index: int, view: View, how: Compared
) -> tuple[Float32[np.ndarray, "H W"], Int64[np.ndarray, " M"], Float32[np.ndarray, " M"]]:
    """Return e of a view, the splats that it shows, and their mean residuals."""
    probe = gaussians.means.new_ones(len(gaussians), 2).requires_grad_()
    photo = view.read()
    truth = np.ascontiguousarray(photo.over(how.settings.background))
    with torch.enable_grad():
        output = how.render(
            gaussians.map(lambda tensor: tensor.detach()),
            how.camera(index, view.camera),
            settings=how.settings,
            features=probe,
        )
    assert output.features is not None, "features were given"
    image = output.image.detach()
    counts, backdrop = photo.mask, None
    if photo.opaque is not None:
        counts = photo.opaque if counts is None else counts & photo.opaque
        backdrop = Backdrop(output.transmittance.detach(), how.settings.background)
    mask = None if counts is None else torch.from_numpy(counts).to(image.device)
    with one_thread():  # the rounding of torch's sums depends on the number of threads
        gains = measured_gains(image, torch.from_numpy(truth).to(image.device), mask)
        image = recolored(image, color_matrix(gains), None, backdrop)
    pixels = truth.astype(np.float32) / (255.0 if truth.dtype == np.uint8 else 1.0)
    error = smoothed_difference(image.clamp(0.0, 1.0).float().numpy(force=True), pixels, photo.mask)
    known = np.isfinite(error)
    planes = np.stack([np.nan_to_num(error), known.astype(np.float32)], axis=-1)
    with torch.enable_grad():  # a sum: given the planes as its gradient, torch would import sympy, in seconds
        whole = (output.features * torch.from_numpy(planes).to(probe)).sum()
    (sums,) = torch.autograd.grad(whole, probe)
    found = sums.float().numpy(force=True)
    shown = np.flatnonzero(found[:, 1] > LEAST_WEIGHT)
    return error, shown, found[shown, 0] / found[shown, 1]


def _expected(
    counts: UInt16[np.ndarray, "N bins"],
) -> tuple[Float32[np.ndarray, "N rules"], Float32[np.ndarray, " N"]]:
    """Return r of every splat for each of `RULES`, and 1 for splats with a base, else 0.

    The rank of a quantile is rounded down, so that with few views it is never the rank of the worst one.
    """
    usual: Float32[np.ndarray, "N rules"] = np.empty((len(counts), len(RULES)), dtype=np.float32)
    base: Float32[np.ndarray, " N"] = np.empty(len(counts), dtype=np.float32)
    for start in range(0, len(counts), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        below = counts[part].cumsum(axis=1, dtype=np.int32)
        views = below[:, -1]
        for i, (quantile, _, _) in enumerate(RULES):
            rank = np.floor(quantile * np.maximum(views - 1, 0)).astype(np.int32)
            usual[part, i] = _VALUES[np.minimum((below <= rank[:, None]).sum(axis=1), BINS - 1)]
        base[part] = views > FEWEST_OTHERS
    return usual, base

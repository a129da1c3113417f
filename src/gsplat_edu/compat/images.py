"""Images from projected Gaussians: our native kernels as a rasteriser of two dimensions.

The kernels project in three dimensions. A camera at the origin with focal length 1 leaves a Gaussian as it is whose
mean is (u, v, 1) and whose covariance is the screen covariance, with zeros in the third row and column: x/z = u, and
J W Sigma W' J' is the covariance itself, exactly. What autograd returns for that mean and covariance are the
gradients of the centre and the screen covariance. All depths are equal, so the order near to far is that of the rows,
unless depths to sort by are given.

gsplat's pixels are sampled at their centres, (0.5, 0.5) for the first, ours at (0, 0): the means move by -0.5 px.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.constants import COLOR_LIMIT
from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.compat.screen import INSTEAD, Lens
from gsplat_edu.render.cpu.render import render_on_screen
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera

SETTINGS = RenderSettings(alpha_max=0.999, z_near=0.0, depth=False, stop="pixel")
"""gsplat's clamp of alpha, and its rule for the end of a pixel."""

COLOR_CHANNELS = 3
"""Channels that the kernels composite as the colour; the others are features."""


class Splats(NamedTuple):
    """M Gaussians of one image."""

    means2d: Float[Tensor, "M 2"]
    """px, gsplat's pixel centres."""
    spreads: Float[Tensor, "M 3"]
    """xx, xy, yy of the screen covariance before eps2d, px², always float64."""
    opacities: Float[Tensor, " M"]
    colors: Float[Tensor, "M D"] | None
    depths: Float[Tensor, " M"] | None
    background: Float[Tensor, " D_plus_E"] | None
    extra_signals: Float[Tensor, "M E"] | None = None
    order: Float[Tensor, " M"] | None = None
    """Not negative, the nearest the smallest; None if the rows are near to far."""


def composite(
    splats: Splats, lens: Lens, absgrad: Callable[[Int64[Tensor, " V"], Tensor], None] | None
) -> tuple[Float[Tensor, "H W K"], Float[Tensor, "H W"]]:
    """Composite colours, then extra signals, then depth, over the background.

    Args:
        splats: The Gaussians; K is the number of colours and extra signals, and one more for depths.
        lens: Size of the image and eps2d.
        absgrad: Receives, in each backward pass, rows and their sums over pixels of |dL/du| and |dL/dv|, per px.

    Returns:
        The channels, and the final transmittance. Differentiable in every tensor of the splats.
    """
    M = len(splats.opacities)
    colors = splats.means2d.new_zeros(M, 0) if splats.colors is None else splats.colors
    front, further = colors, list[Tensor]()
    if colors.shape[1] > COLOR_CHANNELS:
        front, further = colors[:, :COLOR_CHANNELS], [colors[:, COLOR_CHANNELS:]]
    # Extra signals and depth are features, never colours, because the kernels skip Gaussians whose colours exceed
    # COLOR_LIMIT.
    further += [] if splats.extra_signals is None else [splats.extra_signals]
    further += [] if splats.depths is None else [splats.depths[:, None]]
    view = _render(splats, front, torch.cat(further, dim=1) if further else None, lens, absgrad)
    transmittance, image = view.transmittance, view.image
    if front.shape[1] < COLOR_CHANNELS:
        image = image[..., : front.shape[1]]
    if view.features is not None:
        image = torch.cat([image, view.features], dim=-1)
    if splats.background is not None:
        behind = transmittance[..., None] * splats.background
        image = image + (behind if splats.depths is None else torch.nn.functional.pad(behind, (0, 1)))
    return image, transmittance


def _render(
    splats: Splats,
    front: Float[Tensor, "M F"],
    features: Float[Tensor, "M G"] | None,
    lens: Lens,
    absgrad: Callable[[Int64[Tensor, " V"], Tensor], None] | None,
) -> RenderOutput:
    """Composite up to three colours and the features over zero."""
    if front.numel() and float(front.detach().abs().amax()) > COLOR_LIMIT:
        raise ArgumentError(f"colors: exceed {COLOR_LIMIT:g}, beyond which the kernels skip a Gaussian")
    missing = COLOR_CHANNELS - front.shape[1]
    means, cov3ds = _Raised.apply(splats.means2d, splats.spreads)  # type: ignore[no-untyped-call]
    view = render_on_screen(
        (
            means,
            cov3ds,
            front if missing == 0 else torch.nn.functional.pad(front, (0, missing)),
            splats.opacities,
        ),
        *_flat(lens.width, lens.height, lens.eps2d),
        features,
        splats.order,
    )
    if absgrad is not None and means.requires_grad:
        found, visible = view.collect("absgrad"), view.visible
        # The hook runs when the kernels' backward pass has returned the gradient of the means. It holds no tensor of
        # the image: that would be a circle of references through the graph.
        means.register_hook(lambda _: absgrad(visible, found()["absgrad"]))
    return view


@functools.lru_cache(maxsize=16)
def _flat(width: int, height: int, eps2d: float) -> tuple[Camera, RenderSettings]:
    """Return the camera and settings that leave Gaussians on the screen as they are."""
    camera = Camera(np.eye(3), np.zeros(3), 1.0, 1.0, 0.0, 0.0, height, width)
    return camera, dataclasses.replace(SETTINGS, dilation=eps2d)


@first_derivative_only("gsplat's rasterization", INSTEAD)
class _Raised(torch.autograd.Function):
    """Means and covariances in space from those on the screen; autograd would take ten steps."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, spreads: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ANN401
        means, cov3ds = means2d.new_ones(len(means2d), 3), spreads.new_zeros(len(spreads), 9)
        torch.sub(means2d, 0.5, out=means[:, :2])
        cov3ds[:, :2], cov3ds[:, 3], cov3ds[:, 4] = spreads[:, :2], spreads[:, 1], spreads[:, 2]
        return means, cov3ds.view(-1, 3, 3)

    @staticmethod
    def backward(ctx: Any, means: Tensor, cov3ds: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ANN401
        rows = cov3ds.reshape(-1, 9)
        spreads = rows.new_empty(len(rows), 3)
        spreads[:, 0], spreads[:, 2] = rows[:, 0], rows[:, 4]
        torch.add(rows[:, 1], rows[:, 3], out=spreads[:, 1])
        return means[:, :2].contiguous(), spreads


class Absgrad:
    """Sums of absolute gradients, kept at `means2d.absgrad` as gsplat keeps them.

    The attribute exists before the backward pass, filled with zeros. Each backward pass assigns its own sums.

    Args:
        means2d: (..., 2) centres, px; the attribute is added to this tensor.
    """

    def __init__(self, means2d: Tensor) -> None:
        kept, sums = torch.zeros_like(means2d), torch.zeros_like(means2d).view(-1, 2)
        means2d.absgrad = kept  # type: ignore[attr-defined]
        self.means2d = means2d.view_as(means2d)
        """The centres to draw with. Their gradient is complete once every image has added its sums."""
        self._sums = sums

        def publish(_: Tensor) -> None:
            kept.view(-1, 2).copy_(sums)
            sums.zero_()

        if means2d.requires_grad:
            self.means2d.register_hook(publish)  # type: ignore[no-untyped-call]

    def adder(self, rows: Int64[Tensor, " M"]) -> Callable[[Int64[Tensor, " V"], Tensor], None]:
        """Return a function that adds sums, given indices into `rows`, which hold no row twice."""
        sums = self._sums

        def add(visible: Tensor, found: Tensor) -> None:
            sums.index_add_(0, rows[visible], found)

        return add

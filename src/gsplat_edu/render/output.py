"""The result of a render, common to all backends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.moments import AdamInBackward


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """One rendered view.

    Args:
        image: (H, W, 3) composited over the background, not clipped.
        transmittance: (H, W) fraction of light that passes all Gaussians, in [0, 1].
        depth: (H, W) expected depth, sum of w z, world units; not normalised by the sum of w, without background. None
            if `RenderSettings.depth` is off.
        visible: (M,) indices of the Gaussians taking part. On the backend torch: those in front of the camera. On cpu
            and cuda: those whose ellipse alpha >= 1/255 also reaches the image.
        radii: (M, 2) half width and half height of that ellipse, px; 0 if a Gaussian is nowhere above 1/255.
        num_pairs: Number of composited pairs of Gaussian and tile; None on torch, which has no tiles.
        grad_norms: Returns `means2d_grad_norms`.
        defer: Leaves the raw parameters out of the backward pass. Call it before that pass; the returned function then
            finishes the pass once, with a step of Adam instead of gradients. None if the backend does not offer it.
    """

    image: Float[Tensor, "H W 3"]
    transmittance: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None
    visible: Int64[Tensor, " M"]
    radii: Float[Tensor, "M 2"]
    num_pairs: int | None
    grad_norms: Callable[[], Tensor]
    defer: Callable[[], AdamInBackward] | None = None

    def means2d_grad_norms(self) -> Float[Tensor, " M"]:
        """Return the signal for density control: |(gx W/2, gy H/2)|, with g = d loss / d mean in the image, px.

        The factors convert pixels to normalised device coordinates, so that one threshold suits every image size. The
        value is zero for Gaussians that the loss does not reach. A second backward pass through the same image
        accumulates, as for gradients.

        Raises:
            ArgumentError: backward has not been called on a loss of this image.
        """
        return self.grad_norms()


@dataclass(frozen=True, eq=False)
class RenderStack:
    """Several views of equal size, rendered in one call.

    Args:
        image: (B, H, W, 3).
        transmittance: (B, H, W).
        depth: (B, H, W), or None if not requested.
        views: The B individual outputs.
    """

    image: Float[Tensor, "B H W 3"]
    transmittance: Float[Tensor, "B H W"]
    depth: Float[Tensor, "B H W"] | None
    views: tuple[RenderOutput, ...]

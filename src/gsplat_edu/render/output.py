"""What a render gives back, whichever backend made it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float, Int64
from torch import Tensor


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """One rendered view.

    Args:
        image: (H, W, 3) over the background, not clipped.
        transmittance: (H, W) light that passed all Gaussians, in [0, 1].
        depth: (H, W) expected depth, sum of w z, world units: not divided by the sum of w, no background.
            None where `RenderSettings.depth` is off.
        visible: (M,) indices of the Gaussians that take part. On the backend torch: those in front of the
            camera. On cpu and cuda: those whose ellipse alpha >= 1/255 also reaches the image.
        radii: (M, 2) half width and height of that ellipse, px; 0 where a Gaussian is nowhere above 1/255.
        num_pairs: Pairs of Gaussian and tile that were composited; None on torch, which has no tiles.
        grad_norms: Gives `means2d_grad_norms`.
    """

    image: Float[Tensor, "H W 3"]
    transmittance: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None
    visible: Int64[Tensor, " M"]
    radii: Float[Tensor, "M 2"]
    num_pairs: int | None
    grad_norms: Callable[[], Tensor]

    def means2d_grad_norms(self) -> Float[Tensor, " M"]:
        """Return the signal of density control: |(gx W/2, gy H/2)|, g = d loss / d mean in the image, px.

        The factors turn pixels into normalised device coordinates, so that one threshold serves every image
        size. Zero for Gaussians the loss does not reach. A second backward through the same image adds to it, as it
        does to gradients.

        Raises:
            ArgumentError: backward has not run through this image.
        """
        return self.grad_norms()


@dataclass(frozen=True, eq=False)
class RenderStack:
    """Several views of one size, rendered in one call.

    Args:
        image: (B, H, W, 3).
        transmittance: (B, H, W).
        depth: (B, H, W), or None where it was not asked for.
        views: The B single outputs.
    """

    image: Float[Tensor, "B H W 3"]
    transmittance: Float[Tensor, "B H W"]
    depth: Float[Tensor, "B H W"] | None
    views: tuple[RenderOutput, ...]

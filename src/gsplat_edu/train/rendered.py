"""The render of one view of a step, as the terms of an objective read it."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.feed import Draw, Target


@dataclass(frozen=True, eq=False)
class Rendered:
    """The render of one view of a step: the input of an objective's terms.

    Args:
        gaussians: The rendered Gaussians, raw parameters.
        draw: The view and its index.
        output: The render: image, transmittance, and depth if the settings ask for it.
        image: (H, W, 3) the output of the view model, which is compared with the photo.
        target: The photo over the step's background, and its mask.
        iteration: Counted from 0.
        camera: The camera of the render: the view's, or where a view model moved it. None means the view's.
    """

    gaussians: Gaussians
    draw: Draw
    output: RenderOutput
    image: Float[Tensor, "H W 3"]
    target: Target
    iteration: int
    camera: Camera | None = None

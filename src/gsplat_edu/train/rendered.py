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
class Surface:
    """What terms of depth and normals compare: the composited depth, alpha and normals of the same Gaussians.

    Args:
        depth: (H, W) sum of w z, world units; None if it was not rendered.
        alpha: (H, W) sum of w.
        normals: (H, W, 3) composited `gsplat_edu.render.planes.facing_normals`; None if they were not rendered.
    """

    depth: Float[Tensor, "H W"] | None
    alpha: Float[Tensor, "H W"]
    normals: Float[Tensor, "H W 3"] | None


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
        before_shell: What the Gaussians of the scene contribute, without a far shell's; None if there is none.
    """

    gaussians: Gaussians
    draw: Draw
    output: RenderOutput
    image: Float[Tensor, "H W 3"]
    target: Target
    iteration: int
    camera: Camera | None = None
    before_shell: Surface | None = None

    @property
    def surface(self) -> Surface:
        """Depth, alpha and normals for the terms that compare them: those of all Gaussians but a far shell's.

        A sky's distance means nothing. A pixel at the outline of an object mixes both, so that the mean depth of all
        Gaussians lies far behind the object.
        """
        output = self.output
        return self.before_shell or Surface(output.depth, output.alpha, output.features)


def surface_before(output: RenderOutput) -> Surface:
    """Return what lies before a shell, from a render of `gsplat_edu.train.far.features_before`."""
    assert output.features is not None, "the stepper gives them"
    depth, alpha, normals = output.features[..., 0], output.features[..., 1], output.features[..., 2:]
    return Surface(depth, alpha, normals if normals.shape[-1] else None)

"""What the terms of an objective and the view models read of a render, and the render of one view of a step."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from gsplat_edu.render.output import RenderOutput
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.feed import Draw, Target


@dataclass(frozen=True)
class Turns:
    """Some steps of a training.

    Args:
        start: First iteration.
        every: Steps from one to the next.
        batch: Iterations of a step.
    """

    start: int = 0
    every: int = 1
    batch: int = 1

    def due(self, iteration: int) -> bool:
        """Whether the step of this iteration is one of them."""
        return iteration >= self.start and (iteration // self.batch) % self.every == 0


@dataclass(frozen=True)
class Needs:
    """What a term or a view model reads of a render besides image and transmittance; only that is rendered.

    Args:
        depth: The mean depth, `RenderOutput.depth`.
        normals: The composited `gsplat_edu.render.planes.facing_normals`, `RenderOutput.features`, and the depth.
        median_depth: `RenderOutput.median_depth`.
        outside: `gsplat_edu.train.feed.Target.outside`.
        every_pixel: Also pixels that the mask of the photo excludes.
        turns: The steps in which it reads any of that.
    """

    depth: bool = False
    normals: bool = False
    median_depth: bool = False
    outside: bool = False
    every_pixel: bool = True
    turns: Turns = Turns()

    def at(self, iteration: int) -> Needs:
        """Return what is read in the step of an iteration."""
        return (
            self if self.turns.due(iteration) else Needs(outside=self.outside, every_pixel=self.every_pixel)
        )

    def __or__(self, other: Needs) -> Needs:
        """Return what either reads, in every step."""
        return Needs(
            self.depth or other.depth,
            self.normals or other.normals,
            self.median_depth or other.median_depth,
            self.outside or other.outside,
            self.every_pixel or other.every_pixel,
        )


NOTHING = Needs(every_pixel=False)
"""The needs of what reads only pixels that count, of image and transmittance."""


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


def without_shell(output: RenderOutput) -> Surface:
    """Return what lies before a shell, from a render of `gsplat_edu.train.far.features_before`."""
    assert output.features is not None, "the stepper gives them"
    depth, alpha, normals = output.features[..., 0], output.features[..., 1], output.features[..., 2:]
    return Surface(depth, alpha, normals if normals.shape[-1] else None)

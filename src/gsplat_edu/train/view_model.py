"""What lies between the rendered image and the loss of one view.

The photos of a capture differ in more than their cameras: exposure, white balance, vignetting. A view model learns such
a difference for each view, so that the Gaussians need not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gsplat_edu.train.optimizer import ParameterGroup


@runtime_checkable
class ViewModel(Protocol):
    """Turns the rendered image of a view into the one that is compared with the photo.

    Its state is its parameters: leaves that collect gradients, which the trainer's optimiser moves in place, and which
    checkpoints keep, with their moments, by name. Names must differ from those of the Gaussians' parameters.
    """

    def parameters(self) -> Mapping[str, Tensor]:
        """Return what is learned, by name; always the same tensors."""
        ...

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return how each parameter moves, by the same names; none has a row for each Gaussian."""
        ...

    def __call__(self, index: int, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """Return the image that is compared, differentiable in the render and in the parameters.

        Args:
            index: Which of the trainer's views.
            image: (H, W, 3) the render.
        """
        ...


class Identity:
    """The render itself is compared; nothing is learned."""

    def parameters(self) -> Mapping[str, Tensor]:
        """Return none."""
        return {}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return none."""
        return {}

    def __call__(self, index: int, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """Return the image."""
        return image

"""View models, which map the rendered image of a view to the image that its loss compares.

Exposure, white balance and vignetting differ between the photos of a capture. A view model learns such differences for
each view, so that the Gaussians need not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gsplat_edu.train.optimizer import ParameterGroup


@runtime_checkable
class ViewModel(Protocol):
    """Maps the rendered image of a view to the image that is compared with the photo.

    Its state consists of its parameters: leaves that collect gradients. The trainer's optimiser updates them in place,
    and checkpoints store them and their moments by name. Names must differ from those of the Gaussians' parameters.
    """

    def parameters(self) -> Mapping[str, Tensor]:
        """Return the learned tensors by name; always the same objects."""
        ...

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return the optimiser settings by the same names; none is per Gaussian."""
        ...

    def __call__(self, index: int, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """Return the image that is compared, differentiable in the render and in the parameters.

        Args:
            index: Index into the trainer's views.
            image: (H, W, 3) the render.
        """
        ...


class Identity:
    """Compares the render itself and learns nothing."""

    def parameters(self) -> Mapping[str, Tensor]:
        """Return none."""
        return {}

    def groups(self) -> Mapping[str, ParameterGroup]:
        """Return none."""
        return {}

    def __call__(self, index: int, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        """Return the image unchanged."""
        return image

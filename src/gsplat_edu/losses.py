"""What training minimises."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.validation import check_shape


def l1(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Float[Tensor, ""]:
    """Return the mean absolute difference of two images: mean |image - target|.

    Args:
        image: (H, W, 3) rendered.
        target: (H, W, 3) photo.

    Returns:
        () scalar, differentiable in both.

    Raises:
        ShapeError: the two are not of one size.
    """
    check_shape("target", target.shape, image.shape, {})
    return torch.mean(torch.abs(image - target))

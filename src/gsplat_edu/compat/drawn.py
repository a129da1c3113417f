"""What all rasterisations share: limits, the Gaussians that are drawn, their colours, expected depths."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.constants import SH_OFFSET
from gsplat_edu.base.headroom import require_memory
from gsplat_edu.compat.checks import Arguments
from gsplat_edu.compat.harmonics import evaluate
from gsplat_edu.compat.screen import Lens
from gsplat_edu.render.api import BYTES_PER_PIXEL

ALPHA_FLOOR = 1e-10
"""gsplat's lower bound of alpha where it divides the depth by it, for ED."""


class Drawn(NamedTuple):
    """The Gaussians with positive radii, by image."""

    positions: Int64[Tensor, " nnz"]  # in the arrays (B C N)
    scenes: Int64[Tensor, " nnz"]
    images: Int64[Tensor, " nnz"]  # batch times C plus camera
    gaussians: Int64[Tensor, " nnz"]
    ends: list[int]  # of each image


def drawn_at(positions: Int64[Tensor, " nnz"], a: Arguments) -> Drawn:
    """Return what is at positions in the arrays (B C N)."""
    if a.batches * a.C == 1:
        first = torch.zeros_like(positions)
        return Drawn(positions, first, first, positions, [len(positions)])
    images = positions // max(a.N, 1)
    ends = torch.bincount(images, minlength=a.batches * a.C).cumsum(0).tolist()
    return Drawn(positions, images // a.C, images, positions % max(a.N, 1), ends)


def joined(tensor: Tensor, axes: int) -> Tensor:
    """Join the leading axes."""
    return tensor.reshape(math.prod(tensor.shape[:axes]), *tensor.shape[axes:])


def colors_of(a: Arguments, colors: Tensor, drawn: Drawn) -> Float[Tensor, "nnz D"]:
    """Return the colours of the drawn Gaussians, from the harmonics if there are any."""
    row = (drawn.images if a.colors_per_camera else drawn.scenes) * a.N + drawn.gaussians
    if a.sh_degree is None:
        return joined(colors, colors.ndim - 1).index_select(0, row)
    if colors.ndim == 3:
        row = drawn.gaussians  # shared by all scenes
    values = evaluate(a.sh_degree, directions(a, drawn), joined(colors, colors.ndim - 2), (row, drawn.ends))
    return torch.clamp_min(values + SH_OFFSET, 0.0)


def directions(a: Arguments, drawn: Drawn) -> Float[Tensor, "nnz 3"]:
    """Return the vectors from the cameras to the drawn Gaussians."""
    eyes = torch.inverse(a.viewmats)[..., :3, 3]
    if a.viewmats_rs is not None:
        eyes = 0.5 * (eyes + torch.inverse(a.viewmats_rs)[..., :3, 3])
    eyes = eyes.reshape(-1, 3)
    means = joined(a.means, a.means.ndim - 1).index_select(0, drawn.scenes * a.N + drawn.gaussians)
    return means - eyes.index_select(0, drawn.images)


def lens_of(a: Arguments) -> Lens:
    """Return the size of the images, and which Gaussians count."""
    return Lens(a.width, a.height, a.eps2d, a.near_plane, a.far_plane, a.radius_clip)


def require_memory_for(a: Arguments) -> None:
    """Check that there is room for the images.

    Raises:
        NotEnoughMemoryError: there is not.
    """
    require_memory(
        f"{a.batches * a.C} images of {a.width}x{a.height} px",
        BYTES_PER_PIXEL * a.batches * a.C * a.width * a.height,
        "render fewer images, or fewer pixels (width, height)",
    )


def with_expected_depth(image: Tensor, alphas: Tensor) -> Tensor:
    """Return channels of which the last, a sum of weighted depths, is divided by alpha."""
    return torch.cat([image[..., :-1], image[..., -1:] / alphas.clamp(min=ALPHA_FLOOR)], dim=-1)

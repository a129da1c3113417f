"""Autograd, the baseline of the backward rungs: what it keeps for the way back, and the gradients that it finds."""

from __future__ import annotations

from collections.abc import Callable

import torch

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN
from ladder.splats import Splats


def kept_bytes(loss_of: Callable[[], torch.Tensor]) -> int:
    """Differentiate a loss, and return the bytes that autograd kept for it.

    Args:
        loss_of: Computes the loss, a scalar. Storage that several results share counts once.
    """
    kept: dict[int, int] = {}

    def note(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        loss_of().backward()
    return sum(kept.values())


def dense_image(
    means2d: torch.Tensor,
    conics: torch.Tensor,
    colors: torch.Tensor,
    opacities: torch.Tensor,
    H: int,
    W: int,
) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
    """Composite N splats at every pixel, in float64, on black.

    Args:
        means2d: (N, 2) px, near to far.
        conics: (N, 3).
        colors: (N, 3).
        opacities: (N,).
        H: Height, px.
        W: Width, px.

    Returns:
        The image (H, W, 3), and (alphas, T, dx, dy), each (N, H, W).
    """
    y, x = torch.meshgrid(torch.arange(H).double(), torch.arange(W).double(), indexing="ij")
    dx, dy = x - means2d[:, 0, None, None], y - means2d[:, 1, None, None]
    A, B, C = conics[..., None, None].unbind(1)
    alphas = opacities[:, None, None] * torch.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
    alphas = torch.where(alphas < ALPHA_MIN, 0.0, torch.clamp(alphas, max=ALPHA_MAX))
    T = torch.cumprod(torch.cat([torch.ones_like(alphas[:1]), 1 - alphas]), dim=0)
    return torch.einsum("nhw,nc->hwc", T[:-1] * alphas, colors), (alphas, T[:-1], dx, dy)


def autograd_gradients(
    splats: Splats, grad_image: torch.Tensor
) -> tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor, torch.Tensor]:
    """Differentiate sum(image * grad_image) by autograd.

    Returns:
        Means, conics, colours and opacities as float64 leaves, their gradients, and alphas and T of `dense_image`.
    """
    leaves = [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in splats[:4]]
    image, (alphas, T, _, _) = dense_image(*leaves, splats.H, splats.W)
    (image * grad_image).sum().backward()
    return leaves, [leaf.grad for leaf in leaves], alphas.detach(), T.detach()

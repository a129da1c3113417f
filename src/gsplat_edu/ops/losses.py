"""Training losses: L1 and SSIM, natively or in torch; each backend uses one of them (`gsplat_edu.render.backends`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from gsplat_edu.base.buffers import reusable_tensor
from gsplat_edu.base.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA
from gsplat_edu.base.derivatives import chained, first_derivative_only, opaque, refuse_halves
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import native_threads, one_thread
from gsplat_edu.base.validation import check_shape, in_range
from gsplat_edu.ops.kernels import SUFFIXES, kernel, native_array

SSIM_RADIUS = 5
"""Taps of SSIM's window on either side of its middle, px. (Wang et al. 2004: a window of 11)"""

LossKernel = Callable[[Tensor, Tensor, float], Tensor]
"""Computes (1 - k) L1 + k (1 - SSIM) of an image, its target and k, differentiably in the image."""


@opaque
def photo_loss(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"],
    mask: Bool[np.ndarray, "H W"] | Bool[Tensor, "H W"] | None = None,
    ssim_weight: float = 0.2,
    kernel: LossKernel | None = None,
) -> Float[Tensor, ""]:
    """Return the photometric loss of the unmasked pixels: (1 - k) L1 + k (1 - SSIM).

    Masked pixels are black in both image and photo; the mean covers all pixels.

    Args:
        image: (H, W, 3) render.
        target: (H, W, 3) photo, uint8 or float from 0 to 1.
        mask: (H, W) true for pixels that count; None if all count.
        ssim_weight: k, 0 to 1.
        kernel: Computes the loss; `Backend.loss` of the image's backend. `l1_ssim` if None.

    Returns:
        () scalar, differentiable in the image.

    Raises:
        ShapeError: the sizes differ.
        ArgumentError: the image or the photo is float16 or bfloat16.
    """
    _check_halves(image, target)
    if target.dtype != torch.uint8:
        target = target.to(image.dtype)
    if mask is not None:
        counts = torch.as_tensor(mask, device=image.device)[..., None]
        # Multiplication by 0 or 1 is exact, for any number of threads.
        check_shape("mask", counts.shape, (*image.shape[:2], 1), {})
        image = _Masked.apply(image, counts)  # type: ignore[no-untyped-call]
        target = torch.mul(target.detach(), counts, out=reusable_tensor(target.shape, target))
    return (kernel or l1_ssim)(image, target, ssim_weight)


@opaque
@one_thread()  # the rounding of torch's sum depends on the number of threads
def l1(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"]
) -> Float[Tensor, ""]:
    """Return the mean absolute difference of two images: mean |image - target|.

    Args:
        image: (H, W, 3) render.
        target: (H, W, 3) photo, 0 to 1, or uint8, 0 to 255; receives no gradient.

    Returns:
        () scalar, differentiable in the image.

    Raises:
        ShapeError: the sizes differ.
    """
    check_shape("target", target.shape, image.shape, {})
    _check_halves(image, target)
    return torch.mean(torch.abs(image - _as_floats(target, image)))


@opaque
def l1_ssim(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"],
    ssim_weight: float = 0.2,
) -> Float[Tensor, ""]:
    """Return the loss (1 - k) L1 + k (1 - SSIM) used for captures, in one native pass with its gradient.

    SSIM is the mean over pixels and channels, with a Gaussian window of 11 taps (sigma 1.5), zero outside the
    image.

    Args:
        image: (H, W, 3) render, float32 or float64, on the CPU.
        target: (H, W, 3) photo, 0 to 1, of the image's dtype; or uint8, 0 to 255.
        ssim_weight: k, 0 to 1.

    Returns:
        () scalar, differentiable in the image, identical to the bit for any number of threads.

    Raises:
        ShapeError: the image is not (H, W, 3), or the target's size differs.
        ArgumentError: a dtype or device is unsupported, or the weight is outside 0 to 1.

    Source: Kerbl et al. 2023, eq. 7; Wang et al. 2004.
    """
    check_shape("image", image.shape, ("H", "W", 3), {})
    check_shape("target", target.shape, image.shape, {})
    _check_halves(image, target)
    if image.dtype not in SUFFIXES or image.device.type != "cpu":
        raise ArgumentError(
            f"image: is {image.dtype} on {image.device}, but has to be float32 or float64 on the CPU"
        )
    if target.dtype not in (image.dtype, torch.uint8) or target.device.type != "cpu":
        raise ArgumentError(
            f"target: is {target.dtype} on {target.device}, but has to be {image.dtype} or uint8 on cpu"
        )
    weight = in_range("ssim_weight", ssim_weight, 0.0, 1.0)
    loss: Tensor = _L1Ssim.apply(image, target, weight)  # type: ignore[no-untyped-call]
    return loss


@opaque
@one_thread()
def l1_ssim_in_torch(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"] | UInt8[Tensor, "H W 3"],
    ssim_weight: float = 0.2,
) -> Float[Tensor, ""]:
    """Return the loss of `l1_ssim` from its definition, by torch's convolution, on any device.

    SSIM = mean (2 mx my + C1) (2 c + C2) / ((mx² + my² + C1) (vx + vy + C2)),
    with means m, variances v and covariance c under the Gaussian window.

    Args:
        image: (H, W, 3) render.
        target: (H, W, 3) photo, 0 to 1, or uint8, 0 to 255; receives no gradient.
        ssim_weight: k, 0 to 1.

    Raises:
        ShapeError: the sizes differ.
        ArgumentError: the weight is outside 0 to 1.

    Source: Kerbl et al. 2023, eq. 7; Wang et al. 2004.
    """
    weight = in_range("ssim_weight", ssim_weight, 0.0, 1.0)
    mean = l1(image, target)
    if weight == 0.0:
        return mean
    x, y = image, _as_floats(target, image)
    mx, my = _blurred(x), _blurred(y)
    vx, vy, c = _blurred(x * x) - mx * mx, _blurred(y * y) - my * my, _blurred(x * y) - mx * my
    ratio = (2 * mx * my + SSIM_C1) * (2 * c + SSIM_C2)
    ssim = torch.mean(ratio / ((mx * mx + my * my + SSIM_C1) * (vx + vy + SSIM_C2)))
    return (1.0 - weight) * mean + weight * (1.0 - ssim)


def _check_halves(image: Tensor, target: Tensor) -> None:
    for name, tensor in (("image", image), ("target", target)):
        refuse_halves(name, tensor)


def _as_floats(target: Tensor, image: Tensor) -> Tensor:
    """Return a target as numbers of the image's dtype, 0 to 1, without a gradient."""
    return (target.to(image.dtype) / 255.0 if target.dtype == torch.uint8 else target).detach()


def _blurred(image: Tensor) -> Tensor:
    """Convolve (H, W, 3) with the window of SSIM; zero outside the image."""
    steps = torch.arange(2 * SSIM_RADIUS + 1, dtype=image.dtype, device=image.device) - SSIM_RADIUS
    taps = torch.exp(-(steps**2) / (2 * SSIM_SIGMA**2))
    window = (torch.outer(taps, taps) / taps.sum() ** 2)[None, None].repeat(3, 1, 1, 1)
    planes = image.permute(2, 0, 1)[None]
    blurred = torch.nn.functional.conv2d(planes, window, padding=SSIM_RADIUS, groups=3)
    return blurred[0].permute(1, 2, 0)


@first_derivative_only("masked", "image * mask")
class _Masked(torch.autograd.Function):
    """Multiply an image by a mask of 0 and 1, in reused buffers."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, counts: Tensor) -> Tensor:  # noqa: ANN401
        ctx.save_for_backward(counts)
        return torch.mul(image, counts, out=reusable_tensor(image.shape, image))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # noqa: ANN401
        (counts,) = ctx.saved_tensors
        return torch.mul(grad, counts, out=reusable_tensor(grad.shape, grad)), None


@first_derivative_only("l1_ssim", 'l1_ssim_in_torch, the loss of backend="torch"')
class _L1Ssim(torch.autograd.Function):
    """Compute loss and gradient in one pass; backward only scales."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:  # noqa: ANN401
        x, y = image.detach().contiguous(), target.detach().contiguous()
        gradient = reusable_tensor(x.shape, x)
        l1_mean, ssim_mean = kernel("loss_f", x.dtype)(
            image=native_array(x),
            target=native_array(y),
            gradient=native_array(gradient),
            ssim_weight=ssim_weight,
            threads=native_threads(),
        )
        ctx.save_for_backward(gradient)
        return x.new_tensor((1.0 - ssim_weight) * l1_mean + ssim_weight * (1.0 - ssim_mean))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # noqa: ANN401
        (gradient,) = ctx.saved_tensors
        return chained(gradient, grad), None, None

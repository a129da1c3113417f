"""How far rendered depth is from depth that the user has, at samples between pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.base.validation import check_shape
from gsplat_edu.ops.lenses import within_width

LEAST_ALPHA = 0.5
"""Accumulated alpha from which a render has a depth; below it, the mean belongs to what little is there."""


@dataclass(frozen=True)
class DepthRule:
    """How two depths are compared.

    Args:
        weight: Factor of the value.
        bend: delta: relative differences up to this are squared, larger ones count linearly.
        extent: If given, compare 1 / z, times this size of the scene, by the absolute difference.
    """

    weight: float = 1.0
    bend: float = 0.02
    extent: float | None = None


def depth_error(
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
    pixels: Float[Tensor, "M 2"],
    given: Float[Tensor, " M"],
    weights: Float[Tensor, " M"],
    rule: DepthRule,
    wraps: bool = False,
) -> Float[Tensor, ""]:
    """Return the mean difference of rendered and given depth: weight sum_m w_m rho_m / sum_m w_m.

    The rendered depth is z = D / A, with the depth D = sum w z and alpha A interpolated bilinearly at the sample. With
    r = (z - z*) / z*, rho = r² / (2 delta) up to |r| = delta, and |r| - delta / 2 beyond. With an extent, rho = extent
    |1/z - 1/z*|. Samples outside the image or where A is below `LEAST_ALPHA` add 0.

    Args:
        depth: (H, W) sum of w z, world units.
        alpha: (H, W) accumulated alpha.
        pixels: (M, 2) column and row of each sample, px; pixel centres have integer coordinates.
        given: (M,) its depth z*, above 0, world units.
        weights: (M,) at least 0.
        rule: How they are compared.
        wraps: Whether the first and the last column are neighbours (`Projection.wraps`); columns of samples then count
            up to whole widths.

    Returns:
        () scalar, differentiable in depth and alpha; the same bits for any number of threads.

    Raises:
        ShapeError: the sizes differ.
        ArgumentError: the image is smaller than 2x2, or dtypes or devices differ.
    """
    check_shape("depth", depth.shape, ("H", "W"), {})
    check_shape("alpha", alpha.shape, tuple(depth.shape), {})
    count = {"M": len(given)}
    check_shape("pixels", pixels.shape, ("M", 2), count)
    for name, tensor in (("given", given), ("weights", weights)):
        check_shape(name, tensor.shape, ("M",), count)
    for name, tensor in (("alpha", alpha), ("pixels", pixels), ("given", given), ("weights", weights)):
        if (tensor.dtype, tensor.device) != (depth.dtype, depth.device):
            raise ArgumentError(
                f"{name}: is {tensor.dtype} on {tensor.device}, but depth is {depth.dtype} on {depth.device}"
            )
    if min(depth.shape) < 2:
        raise ArgumentError(f"depth: is {depth.shape[1]}x{depth.shape[0]} px, but has to be at least 2x2")
    value: Tensor = _DepthError.apply(  # type: ignore[no-untyped-call]
        depth, alpha, pixels, given, weights, rule, wraps
    )
    return value


@first_derivative_only("depth_error", "torch's own operations")
class _DepthError(torch.autograd.Function):
    """Compute value and gradients together, on one thread; backward only scales."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        depth: Tensor,
        alpha: Tensor,
        pixels: Tensor,
        given: Tensor,
        weights: Tensor,
        rule: DepthRule,
        wraps: bool,
    ) -> Tensor:
        with one_thread():
            H, W = depth.shape
            u, v = pixels.unbind(dim=1)
            if wraps:
                u = within_width(u, W)
            inside = (u >= 0) & ((u <= W - 1) | wraps) & (v >= 0) & (v <= H - 1) & (weights > 0)
            u, v, z, w = (tensor[inside] for tensor in (u, v, given, weights))
            left, top = u.floor().clamp_(max=W - 1 if wraps else W - 2), v.floor().clamp_(max=H - 2)
            a, b = u - left, v - top
            corner, beside = (top * W + left).long(), torch.where(left < W - 1, 1, 1 - W)
            rows = torch.stack([corner, corner + beside, corner + W, corner + W + beside])
            shares = torch.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
            A = (shares * alpha.detach().reshape(-1)[rows]).sum(dim=0)
            D = (shares * depth.detach().reshape(-1)[rows]).sum(dim=0)
            held = (A >= LEAST_ALPHA) & (D > 0)
            A = torch.where(held, A, 1.0)
            found = torch.where(held, D / A, z)
            error, slope = _compared(found, z, rule)
            w = torch.where(held, w, 0.0) * (rule.weight / weights.sum().clamp(min=1e-30))
            each = w * slope / A
            gradients = torch.zeros(2, H * W, dtype=depth.dtype, device=depth.device)
            # not index_add_, whose order of sums on a GPU changes from run to run
            gradients[0].index_put_((rows.reshape(-1),), (shares * each).reshape(-1), accumulate=True)
            gradients[1].index_put_(
                (rows.reshape(-1),), (shares * (-each * found)).reshape(-1), accumulate=True
            )
            ctx.save_for_backward(gradients.reshape(2, H, W))
            return (w * error).sum()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        (gradients,) = ctx.saved_tensors
        if grad.device.type != "cpu" or float(grad) != 1.0:
            gradients = gradients * grad
        return gradients[0], gradients[1], None, None, None, None, None


def _compared(found: Tensor, given: Tensor, rule: DepthRule) -> tuple[Tensor, Tensor]:
    """Return rho and d rho / d z of each sample."""
    if rule.extent is not None:
        off = rule.extent * (1 / found - 1 / given)
        return off.abs(), -off.sign() * rule.extent / (found * found)
    off, bend = (found - given) / given, rule.bend
    near = off.abs() <= bend
    return (
        torch.where(near, off * off / (2 * bend), off.abs() - bend / 2),
        torch.where(near, off / bend, off.sign()) / given,
    )

"""An image through a matrix of colours, differentiably.

y = A x + b                             for an opaque image
y = A (x - T c) + (1 - T) b + T c       for an object before the background c, seen through the transmittance T

The second line recolours the object and leaves the background as it is: x - T c is the object's colour times its
opacity 1 - T. A (3, 3) and b (3,) are passed as one matrix (3, 4).

A falloff v, one number per pixel, then scales the object's light: y becomes v (y + o) - o with the offset o = 0.055 of
the sRGB curve, or v (y - T c + (1 - T) o) - (1 - T) o + T c before a background.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsplat_edu.base.buffers import reusable_tensor
from gsplat_edu.base.constants import SRGB_OFFSET
from gsplat_edu.base.derivatives import first_derivative_only
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import native_threads
from gsplat_edu.base.validation import check_shape
from gsplat_edu.ops import kernels

Color = tuple[float, float, float]


class Backdrop(NamedTuple):
    """The background of an image, and how much of it is visible.

    Args:
        transmittance: (H, W) fraction of the background's light in each pixel.
        background: The background's colour.
    """

    transmittance: Float[Tensor, "H W"]
    background: Color


def recolored(
    image: Float[Tensor, "H W 3"],
    matrix: Float[Tensor, "3 4"],
    photo: UInt8[Tensor, "H W 3"] | None = None,
    backdrop: Backdrop | None = None,
    falloff: Float[Tensor, "H W"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """Return the image with the colours A x + b, or its object with them.

    It uses the native module if that supports the image, else torch. A training uses `Backend.recolored`.

    Args:
        image: (H, W, 3) any range.
        matrix: (3, 4) A and b, of the image's dtype and device.
        photo: (H, W, 3) the photo that the result is compared with. Where it is saturated (255), a result above 1
            becomes 1 and has no gradient: the photo does not tell how bright the scene is there. None if it is not
            stored in bytes.
        backdrop: The background; None recolours every pixel completely. The transmittance has the image's dtype and
            device.
        falloff: (H, W) v, of the image's dtype and device; it counts as constant. None for 1.

    Returns:
        (H, W, 3), differentiable in image, matrix and transmittance.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: matrix, transmittance or falloff has another dtype or device than the image.
    """
    native = kernels.REASON is None and image.device.type == "cpu" and image.dtype in kernels.SUFFIXES
    return (recolored_natively if native else recolored_in_torch)(image, matrix, photo, backdrop, falloff)


def recolored_natively(
    image: Float[Tensor, "H W 3"],
    matrix: Float[Tensor, "3 4"],
    photo: UInt8[Tensor, "H W 3"] | None = None,
    backdrop: Backdrop | None = None,
    falloff: Float[Tensor, "H W"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """Compute `recolored` in one native pass, for images on the CPU; the same bits on any number of threads."""
    through, background = _checked(image, matrix, photo, backdrop, falloff)
    constants = _Constants(photo, falloff, background)
    found: Tensor = _Recolored.apply(image, matrix, through, constants)  # type: ignore[no-untyped-call]
    return found


def recolored_in_torch(
    image: Float[Tensor, "H W 3"],
    matrix: Float[Tensor, "3 4"],
    photo: UInt8[Tensor, "H W 3"] | None = None,
    backdrop: Backdrop | None = None,
    falloff: Float[Tensor, "H W"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """Compute `recolored` by torch's operations, on any device."""
    through, background = _checked(image, matrix, photo, backdrop, falloff)
    corrected = image @ matrix[:, :3].T + matrix[:, 3]
    color = image.new_tensor(background)
    if through is not None:
        corrected = corrected + through[..., None] * (color - matrix[:, :3] @ color - matrix[:, 3])
    if falloff is not None:
        offset = SRGB_OFFSET if through is None else SRGB_OFFSET - through[..., None] * (SRGB_OFFSET + color)
        corrected = falloff[..., None] * (corrected + offset) - offset
    if photo is None:
        return corrected
    return torch.where((photo == 255) & (corrected > 1), torch.ones_like(corrected), corrected)


def _checked(
    image: Tensor, matrix: Tensor, photo: Tensor | None, backdrop: Backdrop | None, falloff: Tensor | None
) -> tuple[Tensor | None, Color]:
    """Check the arguments of `recolored`; return the transmittance, None for an opaque image, and the background."""
    check_shape("image", image.shape, ("H", "W", 3), {})
    check_shape("matrix", matrix.shape, (3, 4), {})
    if photo is not None:
        check_shape("photo", photo.shape, image.shape, {})
    through, background = backdrop or (None, (0.0, 0.0, 0.0))
    for name, tensor in {"transmittance": through, "falloff": falloff}.items():
        if tensor is not None:
            check_shape(name, tensor.shape, image.shape[:2], {})
    for name, tensor in {"matrix": matrix, "transmittance": through, "falloff": falloff}.items():
        if tensor is not None and (tensor.dtype, tensor.device) != (image.dtype, image.device):
            raise ArgumentError(
                f"{name}: is {tensor.dtype} on {tensor.device}, but has to be {image.dtype} on {image.device}"
            )
    return through, background


RecolorKernel = Callable[..., Tensor]
"""Computes `recolored`, from the same arguments."""


class _Constants(NamedTuple):
    """Arguments without a gradient."""

    photo: Tensor | None
    falloff: Tensor | None
    background: Color


@first_derivative_only("recolored", "recolored_in_torch")
class _Recolored(torch.autograd.Function):
    """The native kernel and its gradient."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        image: Tensor,
        matrix: Tensor,
        transmittance: Tensor | None,
        constants: _Constants,
    ) -> Tensor:
        given = [
            None if tensor is None else tensor.detach().contiguous()
            for tensor in (image, matrix, transmittance, constants.photo, constants.falloff)
        ]
        out = reusable_tensor(image.shape, image)
        kernels.kernel("recolor_f", image.dtype)(**_arguments(given, constants.background), out=_array(out))
        ctx.save_for_backward(*given)
        ctx.background = constants.background
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        given = ctx.saved_tensors
        image, matrix, through = given[:3]
        to_image = reusable_tensor(image.shape, image)
        to_matrix = torch.empty_like(matrix) if ctx.needs_input_grad[1] else None
        to_through = None if through is None else reusable_tensor(through.shape, image)
        kernels.kernel("recolor_backward_f", image.dtype)(
            **_arguments(given, ctx.background),
            grad=_array(grad.contiguous()),
            grad_image=_array(to_image),
            grad_transmittance=_array(to_through),
            grad_matrix=_array(to_matrix),
        )
        return to_image, to_matrix, to_through, None


def _arguments(given: Sequence[Tensor | None], background: Color) -> dict[str, Any]:
    names = ("image", "matrix", "transmittance", "photo", "falloff")
    arrays = {name: _array(tensor) for name, tensor in zip(names, given, strict=True)}
    return {**arrays, "background": background, "threads": native_threads()}


def _array(tensor: Tensor | None) -> object:
    return None if tensor is None else kernels.native_array(tensor)

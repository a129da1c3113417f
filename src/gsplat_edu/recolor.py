"""An image through a matrix of colours, differentiably: y = A x + b for every pixel.

A (3, 3) and b (3,) are passed as one matrix (3, 4).
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsplat_edu import kernels
from gsplat_edu.buffers import reusable_tensor
from gsplat_edu.errors import ArgumentError
from gsplat_edu.threads import native_threads
from gsplat_edu.validation import check_shape


def recolored(
    image: Float[Tensor, "H W 3"],
    matrix: Float[Tensor, "3 4"],
    photo: UInt8[Tensor, "H W 3"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """Return the image with the colours A x + b.

    On the CPU this is one native pass, the same to the bit on any number of threads; torch computes it on a GPU and
    without the native module.

    Args:
        image: (H, W, 3) any range.
        matrix: (3, 4) A and b, of the image's dtype and device.
        photo: (H, W, 3) the photo that the result is compared with. Where it is saturated (255), a result above 1
            becomes 1 and has no gradient: the photo does not tell how bright the scene is there. None if it is not
            stored in bytes.

    Returns:
        (H, W, 3), differentiable in image and matrix.

    Raises:
        ShapeError: a shape differs.
        ArgumentError: the matrix has another dtype or device than the image.
    """
    check_shape("image", image.shape, ("H", "W", 3), {})
    check_shape("matrix", matrix.shape, (3, 4), {})
    if photo is not None:
        check_shape("photo", photo.shape, image.shape, {})
    if (matrix.dtype, matrix.device) != (image.dtype, image.device):
        raise ArgumentError(
            f"matrix: is {matrix.dtype} on {matrix.device}, but has to be {image.dtype} on {image.device}"
        )
    if kernels.REASON is None and image.device.type == "cpu" and image.dtype in kernels.SUFFIXES:
        found: Tensor = _Recolored.apply(image, matrix, photo)  # type: ignore[no-untyped-call]
        return found
    corrected = image @ matrix[:, :3].T + matrix[:, 3]
    if photo is None:
        return corrected
    return torch.where((photo == 255) & (corrected > 1), torch.ones_like(corrected), corrected)


class _Recolored(torch.autograd.Function):
    """The native kernel and its gradient."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, matrix: Tensor, photo: Tensor | None) -> Tensor:  # noqa: ANN401
        x, numbers = image.detach().contiguous(), matrix.detach().contiguous()
        bytes_of_photo = None if photo is None else photo.contiguous()
        out = reusable_tensor(x.shape, x)
        kernels.kernel("recolor_f", x.dtype)(
            **_arrays(x, numbers, bytes_of_photo), out=_array(out), **_threads()
        )
        ctx.save_for_backward(x, numbers, bytes_of_photo)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor | None, None]:  # noqa: ANN401
        x, numbers, photo = ctx.saved_tensors
        to_image = reusable_tensor(x.shape, x)
        to_matrix = torch.empty_like(numbers) if ctx.needs_input_grad[1] else None
        kernels.kernel("recolor_backward_f", x.dtype)(
            **_arrays(x, numbers, photo),
            grad=_array(grad.contiguous()),
            grad_image=_array(to_image),
            grad_matrix=None if to_matrix is None else _array(to_matrix),
            **_threads(),
        )
        return to_image, to_matrix, None


def _arrays(image: Tensor, matrix: Tensor, photo: Tensor | None) -> dict[str, Any]:
    return {
        "image": _array(image),
        "matrix": _array(matrix),
        "photo": None if photo is None else _array(photo),
    }


def _array(tensor: Tensor) -> object:
    return kernels.native_array(tensor)


def _threads() -> dict[str, int]:
    return {"threads": native_threads()}

"""The gradient of an image error with respect to all parameters of 2D splats, derived by hand.

Each function is one link of the chain from the image to the parameters: error -> image -> alpha and colour -> conic and
mean -> covariance -> its factor -> log scales and angle. The kernels of `gsplat_edu.render` perform the same steps,
followed by the projection.

Chapter: 08_fit_an_image.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.constants import ALPHA_MAX
from gsplat_edu.base.validation import ArrayLike, check_shape, float64_array
from gsplat_edu.fit2d.splats import Footprint, Render2D, Splats2D, check_same_size

Sums = Float64[np.ndarray, "9"]


def squared_error(image: ArrayLike, target: ArrayLike) -> tuple[float, Float64[np.ndarray, "H W 3"]]:
    """Return the mean squared error of an image, and its gradient with respect to the image.

    L = mean (image - target)²,  dL/dimage = 2 (image - target) / (3 H W)

    Args:
        image: (H, W, 3) render, not clipped.
        target: (H, W, 3) reference.

    Raises:
        ShapeError: the sizes differ.
        ArgumentError: an entry is NaN or infinite.
    """
    check_same_size(image, target)
    difference = float64_array("image", image, ("H", "W", 3)) - float64_array("target", target, ("H", "W", 3))
    return float(np.square(difference).mean()), 2.0 * difference / difference.size


def backward_2d(rendered: Render2D, grad_image: ArrayLike) -> Splats2D:
    """Propagate the gradient of an image to all parameters of its splats.

    With g = dL/dimage at a pixel, R = g . image before the first splat, and i from near to far:

        w = T alpha_i;  R -= w g . c_i;  dL/dalpha_i = T g . c_i - R / (1 - alpha_i);  T *= 1 - alpha_i

    R is the contribution of the splats behind i and of the background to g . image. Where alpha is clamped at 0.99, and
    where it is below the threshold and zero, the gradient of everything inside the exponential is zero.

    Args:
        rendered: The result of `render_2d`.
        grad_image: (H, W, 3) gradient of the loss with respect to the image.

    Returns:
        The gradients of the loss with respect to the raw parameters.

    Raises:
        ShapeError: the gradient's size differs from the image's.
        ArgumentError: it contains NaN or infinity.
    """
    given = float64_array("grad_image", grad_image, ("H", "W", 3))
    check_shape("grad_image", given.shape, rendered.image.shape, {})
    g = np.ascontiguousarray(np.moveaxis(given, -1, 0))
    remainder = (given * rendered.image).sum(axis=-1)
    transmittance = np.ones_like(remainder)
    sums = np.zeros((len(rendered.splats), 9))
    for i, footprint in enumerate(rendered.footprints):
        if footprint.alpha.size:
            window = (footprint.rows, footprint.columns)
            sums[i] = _sums_over_pixels(
                footprint,
                rendered.splats.colors[i],
                g[:, *window],
                transmittance[window],
                remainder[window],
            )
    return _to_parameters(rendered, sums)


def _sums_over_pixels(
    footprint: Footprint,
    color: Float64[np.ndarray, "3"],
    g: Float64[np.ndarray, "3 h w"],
    T: Float64[np.ndarray, "h w"],
    R: Float64[np.ndarray, "h w"],
) -> Sums:
    """Return one splat's sums: w g of three channels, and h, h dx, h dy, h dx², h dx dy, h dy². Updates T and R.

    h = alpha dL/dalpha: the gradient after the exponential, because d alpha / d power = alpha.
    """
    alpha, dx, dy = footprint.alpha, footprint.dx, footprint.dy
    red, green, blue = color.tolist()
    w = T * alpha
    cg = red * g[0] + green * g[1] + blue * g[2]
    R -= w * cg
    h = alpha * (T * cg - R / (1.0 - alpha))
    h[alpha >= ALPHA_MAX] = 0.0
    T *= 1.0 - alpha
    # dx is the same in every row, so rows are summed first and multiplied afterwards.
    h_dy = h * dy
    by_column, dy_by_column, dy2_by_column = h.sum(axis=0), h_dy.sum(axis=0), (h_dy * dy).sum(axis=0)
    moments = np.stack(
        [
            by_column,
            by_column * dx,
            dy_by_column,
            by_column * dx * dx,
            dy_by_column * dx,
            dy2_by_column,
        ]
    ).sum(axis=1)
    return np.concatenate([(w * g).sum(axis=(1, 2)), moments])


def _to_parameters(rendered: Render2D, sums: Float64[np.ndarray, "N 9"]) -> Splats2D:
    """Propagate each splat's sums to its parameters. Lambda: the conic; M = R S: the covariance's factor.

    dL/dmean = Lambda sum h d
    dL/dSigma = Lambda (sum h d d') Lambda / 2,  dL/dM = 2 dL/dSigma M
    dL/dlog s_k = sum_i (dL/dM)_ik M_ik,  dL/dangle = sum of dL/dM * (dR/dangle S)
    dL/dlogit = (1 - o) sum h
    """
    splats = rendered.splats
    A, B, C = np.array([f.conic for f in rendered.footprints]).reshape(-1, 3).T
    h, h_x, h_y, h_xx, h_xy, h_yy = sums[:, 3:].T
    grad_means = np.stack([A * h_x + B * h_y, B * h_x + C * h_y], axis=-1)
    left = np.array([[A * h_xx + B * h_xy, A * h_xy + B * h_yy], [B * h_xx + C * h_xy, B * h_xy + C * h_yy]])
    twice = np.array(  # 2 dL/dSigma, symmetric
        [
            [left[0, 0] * A + left[0, 1] * B, left[0, 0] * B + left[0, 1] * C],
            [left[1, 0] * A + left[1, 1] * B, left[1, 0] * B + left[1, 1] * C],
        ]
    )
    M = np.moveaxis(splats.factors, 0, -1)
    grad_M = twice[:, :1] * M[None, 0] + twice[:, 1:] * M[None, 1]
    turned = np.stack([-M[1], M[0]])  # dR/dangle S: every column of R S rotated by a quarter turn
    return Splats2D(
        means=grad_means,
        log_scales=np.ascontiguousarray((grad_M * M).sum(axis=0).T),
        angles=(grad_M * turned).sum(axis=(0, 1)),
        colors=sums[:, :3].copy(),
        logit_opacities=(1.0 - splats.opacities) * h,
    )

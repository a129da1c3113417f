"""2D splats and their rendering: raw parameters, activations, compositing. All in float64.

The screen-space ellipse of a 3D Gaussian is the primitive here, with a colour and an opacity. The definition of alpha,
its threshold and clamp, the dilation and the compositing are those of `gsplat_edu.render.numpy_reference`.

Chapter: 08_fit_an_image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.constants import ALPHA_MAX, ALPHA_MIN, DILATION
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import (
    ArrayLike,
    check_shape,
    first_index,
    float64_array,
    in_range,
    whole_number,
)

Array = Float64[np.ndarray, "..."]

PER_SPLAT: dict[str, tuple[int, ...]] = {
    "means": (2,),
    "log_scales": (2,),
    "angles": (),
    "colors": (3,),
    "logit_opacities": (),
}
"""The parameters and their shapes per splat: nine values."""


@dataclass(frozen=True, eq=False)
class Splats2D:
    """N splats of an image as raw parameters, near to far. Gradients with respect to them have the same type.

    Args:
        means: (N, 2) centres (u, v), px: column, row.
        log_scales: (N, 2) natural logarithm of the standard deviations along the splat's own axes, px.
        angles: (N,) from the u axis to the splat's first axis, radians; u turns towards v.
        colors: (N, 3) RGB, any range.
        logit_opacities: (N,) logit of the opacities.

    Raises:
        ShapeError: a shape differs, or the parameters have different N.
        ArgumentError: an entry is NaN or infinite.
    """

    means: Float64[np.ndarray, "N 2"]
    log_scales: Float64[np.ndarray, "N 2"]
    angles: Float64[np.ndarray, " N"]
    colors: Float64[np.ndarray, "N 3"]
    logit_opacities: Float64[np.ndarray, " N"]

    def __post_init__(self) -> None:
        """Check shapes and numbers."""
        sizes: dict[str, int] = {}
        for name, array in self.arrays().items():
            checked = float64_array(name, array, ("N", *PER_SPLAT[name]), sizes)
            object.__setattr__(self, name, checked)

    def __len__(self) -> int:
        """Return the number of splats."""
        return len(self.means)

    @property
    def scales(self) -> Float64[np.ndarray, "N 2"]:
        """Standard deviations exp(log_scales), (N, 2), px."""
        return np.asarray(np.exp(self.log_scales))

    @property
    def opacities(self) -> Float64[np.ndarray, " N"]:
        """Opacities sigmoid(logit_opacities) in (0, 1), (N,)."""
        # tanh does not overflow, unlike exp(-x).
        return np.asarray(0.5 * (1.0 + np.tanh(0.5 * self.logit_opacities)))

    @property
    def factors(self) -> Float64[np.ndarray, "N 2 2"]:
        """M = R S, the rotation with its columns multiplied by the scales, (N, 2, 2), px."""
        c, s, (s0, s1) = np.cos(self.angles), np.sin(self.angles), self.scales.T
        return np.stack([np.stack([c * s0, -s * s1], -1), np.stack([s * s0, c * s1], -1)], axis=-2)

    @property
    def cov2d(self) -> Float64[np.ndarray, "N 2 2"]:
        """Covariances including the dilation, M M' + 0.3 I, (N, 2, 2), px²."""
        M = self.factors
        products = (M[:, :, None, :] * M[:, None, :, :]).sum(
            axis=-1
        )  # no BLAS: its sums depend on the threads
        return np.asarray(products + DILATION * np.eye(2))

    def arrays(self) -> dict[str, Array]:
        """Return the raw parameters by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def map(self, change: Callable[[Array], Array]) -> Splats2D:
        """Apply a function to every raw parameter and return the new splats."""
        return Splats2D(**{name: change(array) for name, array in self.arrays().items()})


def random_splats_2d(count: int, height: int, width: int, rng: np.random.Generator) -> Splats2D:
    """Scatter faint round splats over an image as the start of a fit, without knowledge of the image.

    Args:
        count: Number of splats, N.
        height: Height of the image, px.
        width: Width of the image, px.
        rng: Generator for the means, then the colours.

    Returns:
        N splats with uniform means, colours uniform in 0..1, opacity 1/2, and a size that covers the image: scale
        sqrt(height width / N) / 2.

    Raises:
        ArgumentError: a count or size is not a whole number of at least 1.
    """
    for name, value in (("count", count), ("height", height), ("width", width)):
        whole_number(name, value, 1)
    scale = 0.5 * np.sqrt(height * width / count)
    return Splats2D(
        means=rng.uniform(-0.5, (width - 0.5, height - 0.5), (count, 2)),
        log_scales=np.full((count, 2), np.log(scale)),
        angles=np.zeros(count),
        colors=rng.uniform(size=(count, 3)),
        logit_opacities=np.zeros(count),
    )


class Footprint(NamedTuple):
    """The pixels that a splat reaches, and its alpha there."""

    rows: slice
    columns: slice
    dx: Float64[np.ndarray, " w"]  # column minus mean, px
    dy: Float64[np.ndarray, "h 1"]  # row minus mean, px
    conic: tuple[float, float, float]  # inverse covariance (uu, uv, vv), px⁻²
    alpha: Float64[np.ndarray, "h w"]


class Render2D(NamedTuple):
    """A rendered image and the data for its backward pass.

    Args:
        image: (H, W, 3) not clipped.
        transmittance: (H, W) remaining weight of the background.
        splats: The rendered splats.
        footprints: One per splat, in order.
    """

    image: Float64[np.ndarray, "H W 3"]
    transmittance: Float64[np.ndarray, "H W"]
    splats: Splats2D
    footprints: tuple[Footprint, ...]


def render_2d(splats: Splats2D, height: int, width: int, background: ArrayLike = (0, 0, 0)) -> Render2D:
    """Composite splats over a background; the first splat is the nearest.

    alpha_i = min(0.99, o_i exp(-d' Sigma_i^-1 d / 2)), 0 below 1/255;  d = pixel - mean
    image = sum_i T_i alpha_i c_i + T_final bg,  T_i = product over j < i of (1 - alpha_j)

    Args:
        splats: N splats; every pixel with alpha >= 1/255 is drawn.
        height: Height of the image, px.
        width: Its width, px.
        background: (3,) colour behind the last splat.

    Returns:
        The image, including the data for `backward_2d`.

    Raises:
        ShapeError: the background is not of shape (3,).
        ArgumentError: the size is not a whole number of at least 1, or a scale is so large that its square overflows.
    """
    height, width = whole_number("height", height, 1), whole_number("width", width, 1)
    behind = float64_array("background", background, (3,))
    planes, transmittance = np.zeros((3, height, width)), np.ones((height, width))
    footprints = _footprints(splats, height, width)
    for footprint, color in zip(footprints, splats.colors, strict=True):
        T = transmittance[footprint.rows, footprint.columns]
        weight = T * footprint.alpha
        planes[:, footprint.rows, footprint.columns] += color[:, None, None] * weight
        T *= 1.0 - footprint.alpha  # a view into the image's transmittance
    planes += behind[:, None, None] * transmittance
    image = np.ascontiguousarray(np.moveaxis(planes, 0, -1))
    return Render2D(image, transmittance, splats, footprints)


def _footprints(splats: Splats2D, height: int, width: int) -> tuple[Footprint, ...]:
    """Evaluate every splat's alpha on the box around its ellipse alpha = 1/255, clipped to the image."""
    opacities = splats.opacities
    with np.errstate(over="ignore", invalid="ignore"):  # reported by name below
        cov2d = splats.cov2d
        a, b, c = cov2d[:, 0, 0], cov2d[:, 0, 1], cov2d[:, 1, 1]
        det = (splats.scales**2 + DILATION).prod(axis=-1)  # a c - b b would lose a needle's digits
        conics = np.stack([c, -b, a], axis=-1) / det[:, None]
    if np.any(lost := ~(np.isfinite(conics).all(axis=-1) & np.isfinite(cov2d).all(axis=(-2, -1)))):
        raise ArgumentError(f"log_scales{first_index(lost)}: is too large to be drawn; take smaller steps")
    level = 2.0 * np.log(np.maximum(opacities, ALPHA_MIN) / ALPHA_MIN)
    reach = np.ceil(np.sqrt(level[:, None] * np.stack([a, c], axis=-1)))
    low = np.clip(np.floor(splats.means) - reach, 0, (width, height)).astype(int)
    high = np.clip(np.ceil(splats.means) + reach + 1, 0, (width, height)).astype(int)
    across, down = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)[:, None]
    made = []
    for i, (A, B, C) in enumerate(conics.tolist()):
        rows, columns = slice(low[i, 1], high[i, 1]), slice(low[i, 0], high[i, 0])
        dx, dy = across[columns] - splats.means[i, 0], down[rows] - splats.means[i, 1]
        power = dy * (-0.5 * C * dy - B * dx) - 0.5 * A * dx * dx
        alpha = np.minimum(ALPHA_MAX, opacities[i] * np.exp(power))
        alpha[alpha < ALPHA_MIN] = 0.0
        made.append(Footprint(rows, columns, dx, dy, (A, B, C), alpha))
    return tuple(made)


def ellipses_2d(splats: Splats2D, deviations: float = 1.0, points: int = 40) -> Float64[np.ndarray, "N P 2"]:
    """Trace the splats' ellipses, including the dilation, for plotting.

    The ellipse d' Sigma^-1 d = deviations² is mean + deviations L (cos t, sin t),  Sigma = L L'.

    Args:
        splats: N splats.
        deviations: Distance from the mean in standard deviations.
        points: Number of points P, equidistant in t from 0 to 2 pi.

    Returns:
        (N, P, 2) closed curves (u, v), px.

    Raises:
        ArgumentError: fewer than 3 points, or deviations not positive.
    """
    deviations = in_range("deviations", deviations, 0.0, open_low=True)
    t = np.linspace(0.0, 2.0 * np.pi, whole_number("points", points, 3))
    circle = deviations * np.stack([np.cos(t), np.sin(t)], axis=-1)
    L = np.linalg.cholesky(splats.cov2d)
    steps = (L[:, None, :, :] * circle[None, :, None, :]).sum(axis=-1)
    return np.asarray(splats.means[:, None, :] + steps)


def check_same_size(image: ArrayLike, target: ArrayLike) -> None:
    """Check that two arrays are images of equal size.

    Raises:
        ShapeError: they are not images, or their sizes differ.
    """
    sizes: dict[str, int] = {}
    check_shape("image", np.shape(image), ("H", "W", 3), sizes)
    check_shape("target", np.shape(target), ("H", "W", 3), sizes)

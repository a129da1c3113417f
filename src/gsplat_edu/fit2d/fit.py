"""The loop that fits 2D splats to an image: render, compare, differentiate, step.

Chapter: 08_fit_an_image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, UInt8

from gsplat_edu.base.errors import ShapeError
from gsplat_edu.base.validation import ArrayLike, check_shape, float64_array, in_range, whole_number
from gsplat_edu.fit2d.adam import AdamSettings, AdamState, adam_step_2d
from gsplat_edu.fit2d.gradients import backward_2d, squared_error
from gsplat_edu.fit2d.splats import Render2D, Splats2D, check_same_size, render_2d
from gsplat_edu.scene.photo import shrunk

SQUARED_ERROR_FLOOR = 1e-10
"""Smallest mean squared error: equal images have 100 dB, as in `gsplat_edu.evaluate.metrics`."""


@dataclass(frozen=True)
class Fit2DSettings:
    """Settings of a fit.

    Args:
        iterations: Number of steps.
        background: (r, g, b) behind the splats.
        adam: Learning rates, decays, eps.
        final_factor: Factor reached by exponential decay of the learning rates at the last step; 1 keeps them constant.

    Raises:
        ShapeError: the background does not have three values.
        ArgumentError: a number is out of range.
    """

    iterations: int = 400
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    adam: AdamSettings = field(default_factory=AdamSettings)
    final_factor: float = 0.1

    def __post_init__(self) -> None:
        """Check the ranges."""
        whole_number("iterations", self.iterations, 1)
        float64_array("background", self.background, (3,))
        in_range("final_factor", self.final_factor, 0.0, 1.0, open_low=True)


class Step2D(NamedTuple):
    """State of a fit before a step, and after the last one.

    Args:
        iteration: Steps taken so far, 0 to `iterations`.
        loss: Mean squared error of the render, not clipped.
        psnr: PSNR of the render, dB.
        rendered: The render and its splats.
    """

    iteration: int
    loss: float
    psnr: float
    rendered: Render2D


class Fit2D(NamedTuple):
    """Result of a fit.

    Args:
        splats: The fitted splats.
        image: (H, W, 3) their render, not clipped.
        losses: Mean squared error before each step and after the last one.
        psnrs: PSNR at the same times, dB.
    """

    splats: Splats2D
    image: Float64[np.ndarray, "H W 3"]
    losses: list[float]
    psnrs: list[float]


def fit_2d(
    target: ArrayLike,
    splats: Splats2D,
    settings: Fit2DSettings | None = None,
    callbacks: Sequence[Callable[[Step2D], None]] = (),
) -> Fit2D:
    """Fit splats to an image.

    Equal arguments give equal bits, for any number of threads, because all sums are NumPy's.

    Args:
        target: (H, W, 3) the image, 0 to 1.
        splats: Initial splats; their number and order stay the same.
        settings: Iterations, learning rates, background; None uses the defaults.
        callbacks: Called with the state before every step and after the last one.

    Returns:
        The fitted splats, their render and the curves.

    Raises:
        ShapeError: the target is not (H, W, 3).
        ArgumentError: it contains NaN or infinity.
    """
    settings = settings or Fit2DSettings()
    truth = float64_array("target", target, ("H", "W", 3))
    if not truth.size:
        raise ShapeError(f"target: has no pixels, its shape is {truth.shape}")
    height, width = truth.shape[:2]
    losses: list[float] = []
    psnrs: list[float] = []

    def render(iteration: int, splats: Splats2D) -> tuple[Render2D, Float64[np.ndarray, "H W 3"]]:
        rendered = render_2d(splats, height, width, settings.background)
        loss, grad_image = squared_error(rendered.image, truth)
        losses.append(loss)
        psnrs.append(psnr_2d(rendered.image, truth))
        for callback in callbacks:
            callback(Step2D(iteration, loss, psnrs[-1], rendered))
        return rendered, grad_image

    state = AdamState.fresh(splats)
    for iteration in range(settings.iterations):
        factor = settings.final_factor ** (iteration / max(1, settings.iterations - 1))
        gradients = backward_2d(*render(iteration, splats))
        splats, state = adam_step_2d(splats, gradients, state, settings.adam, factor)
    rendered, _ = render(settings.iterations, splats)
    return Fit2D(splats, rendered.image, losses, psnrs)


def psnr_2d(image: ArrayLike, target: ArrayLike) -> float:
    """Return the PSNR of the image clamped to 0..1: -10 log10(max(MSE, 1e-10)).

    Args:
        image: (H, W, 3) render.
        target: (H, W, 3) reference, 0 to 1.

    Returns:
        dB; 100 for equal images. The same value as `gsplat_edu.evaluate.metrics.psnr`, without torch.

    Raises:
        ShapeError: the sizes differ.
    """
    check_same_size(image, target)
    error = float(np.square(np.clip(image, 0.0, 1.0) - np.asarray(target)).mean())
    return float(-10.0 * np.log10(max(error, SQUARED_ERROR_FLOOR)))


def shrunk_photo(pixels: UInt8[np.ndarray, "H W 3"], longest: int) -> Float64[np.ndarray, "h w 3"]:
    """Downscale a photo for fitting; each new pixel is the mean of the area it covers.

    Args:
        pixels: (H, W, 3) photo, uint8.
        longest: Length of the longer side after scaling, px; a smaller photo keeps its size.

    Returns:
        (h, w, 3) from 0 to 1.

    Raises:
        ShapeError: not (H, W, 3).
        ArgumentError: `longest` is not a whole number of at least 1.
    """
    check_shape("pixels", pixels.shape, ("H", "W", 3), {})
    return np.asarray(shrunk(pixels, whole_number("longest", longest, 1)), dtype=np.float64) / 255.0

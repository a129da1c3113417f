"""The result of a render, common to all backends.

Chapter: 16_birth_and_death.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from jaxtyping import Float, Int64
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError, ShapeError
from gsplat_edu.base.pictures import png, show, write_png
from gsplat_edu.ops.moments import AdamInBackward
from gsplat_edu.scene.gaussians import check_tensor

MOST_CHANNELS = 32
"""Largest number of channels of features in one pass of the native kernels."""

STATISTICS = ("abs_u", "abs_v", "weight_sum", "pixels", "error_sum", "weight_max")
"""Columns of the kernels' statistics, in order."""

COLLECTED = {
    "absgrad": ("abs_u", "abs_v"),
    "weight_sum": ("weight_sum",),
    "weight_max": ("weight_max",),
    "pixels": ("pixels",),
    "error_sum": ("error_sum",),
}
"""The statistics of `RenderOutput.collect` by name, and their columns."""


class Extra(NamedTuple):
    """Optional inputs of a render.

    Args:
        background: (3,) colour behind everything, of the Gaussians' dtype.
        features: (N, C) features to composite, or None.
        needed: (H, W) bool, true for the pixels that the caller uses; None for all. The others are undefined, but
            finite, and their gradients have to be 0. The backend cpu draws no tile without a needed pixel.
    """

    background: Tensor
    features: Tensor | None = None
    needed: Tensor | None = None


def check_features(features: Tensor, means: Tensor) -> int:
    """Check features of the Gaussians with these means; return their number of channels.

    Raises:
        ShapeError: the features are not of shape (N, 1 or more).
        ArgumentError: they are not a tensor, of another dtype or device than the means, or a value is NaN or infinite.
    """
    sizes = {"N": len(means)}
    check_tensor("features", features, ("N", "C"), sizes)
    if not sizes["C"]:
        raise ShapeError("features: have no channels, but need one or more; None stands for no features")
    if (features.dtype, features.device) != (means.dtype, means.device):
        wanted = f"{means.dtype} on {means.device}"
        raise ArgumentError(f"features: are {features.dtype} on {features.device}, but means are {wanted}")
    return sizes["C"]


@dataclass(frozen=True, eq=False, repr=False)
class RenderOutput:
    """One rendered view.

    Args:
        image: (H, W, 3) composited over the background, not clipped.
        transmittance: (H, W) fraction of light that passes all Gaussians, in [0, 1].
        depth: (H, W) expected depth, sum of w z, world units; not normalised by the sum of w, without background. None
            if `RenderSettings.depth` is off.
        visible: (M,) indices of the Gaussians taking part. On the backend torch: those in front of the camera. On cpu
            and cuda: those whose ellipse alpha >= 1/255 also reaches the image.
        radii: (M, 2) half width and half height of that ellipse, px; 0 if a Gaussian is nowhere above 1/255.
        num_pairs: Number of composited pairs of Gaussian and tile; None on torch, which has no tiles.
        grad_norms: Returns `means2d_grad_norms`.
        features: (H, W, C) sum of w f for the features f that were given, over zero; None if there were none.
        median_depth: (H, W) depth of the Gaussian at which the transmittance falls below one half, world units; 0 where
            it does not. It has no gradient. None if `RenderSettings.median_depth` is off.
        collector: What `collect` uses; None if the backend does not collect.
        defer: Leaves the raw parameters out of the backward pass. Call it before that pass; the returned function then
            finishes the pass once, with a step of Adam instead of gradients. None if the backend does not offer it.
    """

    image: Float[Tensor, "H W 3"]
    transmittance: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None
    visible: Int64[Tensor, " M"]
    radii: Float[Tensor, "M 2"]
    num_pairs: int | None
    grad_norms: Callable[[], Tensor]
    defer: Callable[[], AdamInBackward] | None = None
    features: Float[Tensor, "H W C"] | None = None
    median_depth: Float[Tensor, "H W"] | None = None
    collector: Callable[[Tensor | None], Callable[[], Tensor]] | None = None

    def __repr__(self) -> str:
        """Return one line: size, number of visible Gaussians, dtype and device."""
        H, W = self.transmittance.shape
        dtype = str(self.image.dtype).removeprefix("torch.")
        return f"RenderOutput({W}x{H} px, {len(self.visible):,} Gaussians, {dtype} on {self.image.device})"

    def _repr_png_(self) -> bytes:
        return png(self.image)

    def show(self) -> None:
        """Show the image in the notebook, or in the browser; without a screen, say what to do.

        Raises:
            ArgumentError: a pixel is NaN or infinite.
        """
        show(self, self.image, 'output.save("render.png") writes the picture')

    def save(self, path: str | Path) -> None:
        """Write the image as an 8-bit PNG: clamped to 0..1, rounded, under a temporary name that is then replaced.

        Args:
            path: Output file, which ends in .png; parent folders are created.

        Raises:
            ArgumentError: the file has another ending, or a pixel is NaN or infinite.
            OSError: the file cannot be written. An existing file stays unchanged.
        """
        write_png(path, self.image)

    @property
    def alpha(self) -> Float[Tensor, "H W"]:
        """Accumulated alpha: 1 - transmittance. Differentiable."""
        return 1.0 - self.transmittance

    @property
    def mean_depth(self) -> Float[Tensor, "H W"]:
        """Depth divided by alpha, world units; 0 where nothing was drawn. Differentiable.

        Raises:
            ArgumentError: `RenderSettings.depth` is off.
        """
        if self.depth is None:
            raise ArgumentError("depth: was not rendered; set RenderSettings(depth=True)")
        drawn = self.alpha > 0
        # where() twice keeps the division by 0 out of the chain rule.
        return (self.depth / self.alpha.where(drawn, 1.0)).where(drawn, 0.0)

    def collect(self, *names: str, errors: Tensor | None = None) -> Callable[[], dict[str, Tensor]]:
        """Ask the backward pass for statistics of the visible Gaussians. Call it before that pass.

        Each statistic is a sum or maximum over the pixels of this image, with w = T alpha. They have the same bits for
        any number of threads. After several passes, they describe the last one. "absgrad" is
        the sum over the features that are composited together: at least the sum of the absolute values. On the backend
        cpu, these are colours with 32 features, then 32 each; on webgpu colours, then four features each.

        Args:
            names: "absgrad": (M, 2) sums of |d loss / d mean in the image|, each pixel's by itself (AbsGS); per px.
                "weight_sum", "weight_max": (M,) sum and maximum of w. "pixels": (M,) number of pixels with w > 0.
                "error_sum": (M,) sum of w times the pixel's error.
            errors: (H, W) error of each pixel, for "error_sum".

        Returns:
            A function that returns the statistics by name, after the backward pass.

        Raises:
            ArgumentError: a name is unknown, "error_sum" has no errors, or the backend does not collect statistics.
            ShapeError: the errors have another size than the image.
        """
        if unknown := [name for name in names if name not in COLLECTED]:
            raise ArgumentError(f"collect: does not know {unknown[0]!r}; use {', '.join(COLLECTED)}")
        if not names or ("error_sum" in names) != (errors is not None):
            raise ArgumentError("collect: give at least one name, and errors exactly with error_sum")
        if self.collector is None:
            raise ArgumentError("collect: only the backends cpu and webgpu collect statistics")
        found = self.collector(errors)

        def statistics() -> dict[str, Tensor]:
            table = found()
            columns = {name: [STATISTICS.index(column) for column in COLLECTED[name]] for name in names}
            return {name: table[:, at].squeeze(-1) for name, at in columns.items()}

        return statistics

    def means2d_grad_norms(self) -> Float[Tensor, " M"]:
        """Return the signal for density control: |(gx W/2, gy H/2)|, with g = d loss / d mean in the image, px.

        The factors convert pixels to normalised device coordinates, so that one threshold suits every image size. The
        value is zero for Gaussians that the loss does not reach. A second backward pass through the same image
        accumulates, as for gradients; so do the passes of more than 32 features on the backend cpu.

        Raises:
            ArgumentError: backward has not been called on a loss of this image.
        """
        return self.grad_norms()


@dataclass(frozen=True, eq=False)
class RenderStack:
    """Several views of equal size, rendered in one call.

    Args:
        image: (B, H, W, 3).
        transmittance: (B, H, W).
        depth: (B, H, W), or None if not requested.
        views: The B individual outputs.
        features: (B, H, W, C), or None if none were given.
        median_depth: (B, H, W), or None if not requested.
    """

    image: Float[Tensor, "B H W 3"]
    transmittance: Float[Tensor, "B H W"]
    depth: Float[Tensor, "B H W"] | None
    views: tuple[RenderOutput, ...]
    features: Float[Tensor, "B H W C"] | None = None
    median_depth: Float[Tensor, "B H W"] | None = None

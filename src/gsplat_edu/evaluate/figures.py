"""The pictures of a training run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gsplat_edu.files import written_aside

DPI = 150


def held_out_figure(panels: Sequence[tuple[str, Float[np.ndarray, "H W 3"]]]) -> Figure:
    """Show renders of the held-out camera side by side.

    Args:
        panels: Title and (H, W, 3) image of each; values outside 0 to 1 are clipped.

    Returns:
        The figure; no pixel is interpolated.
    """
    figure = Figure(figsize=(3.3 * len(panels), 3.8), layout="constrained")
    for axes, (title, image) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        axes.imshow(np.clip(image, 0.0, 1.0), interpolation="nearest")
        axes.set_title(title)
        axes.axis("off")
    figure.suptitle("what the held-out camera sees")
    return figure


def curves_figure(losses: Sequence[float], counts: Sequence[int]) -> Figure:
    """Plot the training loss, on a logarithmic scale, and the number of Gaussians.

    Args:
        losses: L1 of every iteration.
        counts: Gaussians of every iteration.
    """
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    loss_axes, count_axes = figure.subplots(1, 2)
    loss_axes.semilogy(losses, linewidth=0.8)
    loss_axes.set(title="training loss", xlabel="iteration", ylabel="L1 of the iteration's view")
    count_axes.plot(counts)
    count_axes.set(title="density control", xlabel="iteration", ylabel="number of Gaussians", ylim=(0, None))
    for axes in (loss_axes, count_axes):
        axes.grid(alpha=0.3)
    return figure


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG; parent folders are made.

    Raises:
        OSError: the file cannot be written. What stood there before is untouched.
    """
    with written_aside(path) as aside:
        FigureCanvasAgg(figure).figure.savefig(aside, dpi=DPI, format="png")

"""Figures of a training run."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from gsplat_edu.base.files import written_aside

DPI = 150

CURVE_POINTS = 400
"""Largest number of points of a curve in a report; longer logs are averaged over intervals of equal length."""

MOST_SHOWN, SHOWN_QUANTILE = 2.0, 0.95
"""Cut off the curve of the speed at twice its 95 % quantile, because a pause of the computer would flatten the rest."""

SVG_FACTS = ("Creator", "Date", "Format", "Type")
"""Metadata that matplotlib writes into an SVG by default (dates and addresses); left out here."""

CURVE_INCHES = (5.0, 2.9)
"""Width and height of a curve's figure."""

LABELS_INCHES, CHARACTER_INCHES = 0.42, 0.09
"""Space to the left of the axes, inches: for the label, and for each character of the numbers along the axis (DejaVu
Sans, 10 pt)."""

RUN_CURVES = (
    ("loss", "training loss", "loss of each iteration's view"),
    ("psnr", "held-out views", "PSNR of the test views (dB)"),
    ("num_gaussians", "density control", "number of Gaussians"),
    ("photo_factor", "size of the photos", "divisor of width and height"),
    ("ms", "speed", "ms per iteration"),
)
"""A run's curves: key in the log, title, label."""


def held_out_figure(panels: Sequence[tuple[str, Float[np.ndarray, "H W 3"]]]) -> Figure:
    """Show renders of the held-out view side by side.

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
    figure.suptitle("renders of the held-out view")
    return figure


def curves_figure(losses: Sequence[float], counts: Sequence[int]) -> Figure:
    """Plot the training loss, on a logarithmic scale, and the number of Gaussians.

    Args:
        losses: L1 of each iteration.
        counts: Number of Gaussians at each iteration.
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


def run_curve_figures(log: Sequence[Mapping[str, Any]], cap: int | None = None) -> list[Figure]:
    """Plot a run's log: loss, PSNR of evaluations, Gaussians, size of the photos, ms per iteration, objective's terms.

    Args:
        log: Lines of the log: `iteration`, and any of loss, psnr, num_gaussians, photo_factor, ms, terms. A key without
            values gets no curve; neither do the terms if the loss is the only one, nor the size of the photos if it is
            constant.
        cap: Cap on the number of Gaussians; None for none.

    Returns:
        One figure for each curve; they share the range of iterations.
    """
    curves: list[tuple[str, str, str, dict[str, Float[np.ndarray, "Q 2"]]]] = []
    for key, title, label in RUN_CURVES:
        points = _points(log, key)
        if points is not None and (key != "photo_factor" or np.ptp(points[:, 1]) > 0):
            curves.append((key, title, label, {"": points}))
    if len(terms := _terms(log)) > 1:
        curves.append(("terms", "terms of the objective", "weighted value", terms))
    last = max((float(points[-1, 0]) for *_, lines in curves for points in lines.values()), default=0.0)
    figures = []
    for key, title, label, lines in curves:
        figure = Figure(figsize=CURVE_INCHES)
        axes = figure.subplots()
        for name, points in lines.items():
            marker = "o" if len(points) < 40 else ""
            axes.plot(*points.T, linewidth=1.0, marker=marker, markersize=3, label=name)
        values = np.concatenate([points[:, 1] for points in lines.values()])
        if key == "num_gaussians" and cap is not None:
            axes.axhline(cap, color="0.5", linewidth=1.0, linestyle="--", label="cap")
            axes.legend(loc="lower right")
            values = np.append(values, cap)
        axes.set(title=title, xlabel="iteration", ylabel=label)
        axes.set_xlim(0.0, 1.03 * last if last > 0 else 1.0)
        axes.grid(alpha=0.3)
        if len(lines) > 1:
            axes.legend()
        if key in ("loss", "terms") and values.min() >= 0 and values.max() > 0:
            _decades(axes, values[values > 0])  # log(0): the curve of a term that ends drops below the axes
        if key in ("num_gaussians", "ms"):
            axes.set_ylim(0, 1.05 * max(values.max(), 1.0))  # a count that hardly changes stays off the edge
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        if key == "ms":
            _cut_peaks(axes, title, values)
        _set_margins(figure, values)
        figures.append(figure)
    return figures


def _set_margins(figure: Figure, values: Float[np.ndarray, " Q"]) -> None:
    """Leave room for the labels. A layout engine measures them by drawing, which doubles the time of a report."""
    width, height = CURVE_INCHES
    characters = max(len("0.0001"), len(f"{values.max():,.0f}"))
    left = LABELS_INCHES + CHARACTER_INCHES * characters
    figure.subplots_adjust(left / width, 0.5 / height, 1 - 0.2 / width, 1 - 0.32 / height)


def _decades(axes: Axes, values: Float[np.ndarray, " Q"]) -> None:
    """Make the vertical axis logarithmic, with a few plain numbers: 0.2, not 2 x 10^-1."""
    axes.set_yscale("log")
    wide = values.max() > 10 * values.min()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3) if wide else (1, 1.5, 2, 3, 5, 7)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _cut_peaks(axes: Axes, title: str, values: Float[np.ndarray, " Q"]) -> None:
    """Cut off peaks of the curve, and state the largest value."""
    top, peak = MOST_SHOWN * float(np.quantile(values, SHOWN_QUANTILE)), float(values.max())
    if 0.0 < top < peak:
        axes.set(ylim=(0.0, top), title=f"{title} (peaks of up to {peak:,.0f} ms are cut off)")


def svg_element(figure: Figure, name: str = "figure") -> str:
    """Return a figure as an <svg> element for a web page. Equal figures and names give equal bytes.

    Args:
        figure: The figure.
        name: Goes into the ids of its parts, which have to differ from those of another figure on the page.
    """
    text = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": f"gsplat_edu {name}", "svg.fonttype": "path"}):
        FigureCanvasAgg(figure).figure.savefig(text, format="svg", metadata=dict.fromkeys(SVG_FACTS))
    drawing = text.getvalue()
    return drawing[
        drawing.index("<svg") :
    ]  # without the XML and DOCTYPE lines, which do not belong inside a page


def _points(log: Sequence[Mapping[str, Any]], key: str) -> Float[np.ndarray, "Q 2"] | None:
    """Return iteration and value of the lines that have both; None where none has."""
    pairs = [(line.get("iteration"), line.get(key)) for line in log]
    finite = [pair for pair in pairs if all(isinstance(v, int | float) and math.isfinite(v) for v in pair)]
    return _thinned(np.array(finite, dtype=np.float64)) if finite else None


def _terms(log: Sequence[Mapping[str, Any]]) -> dict[str, Float[np.ndarray, "Q 2"]]:
    """Return the points of every term of the objective that the log names."""
    lines = [
        (line.get("iteration"), terms) for line in log if isinstance(terms := line.get("terms"), Mapping)
    ]
    names = list(dict.fromkeys(name for _, terms in lines for name in terms))
    found = {
        name: _points([{"iteration": i, name: terms.get(name)} for i, terms in lines], name) for name in names
    }
    return {name: points for name, points in found.items() if points is not None}


def _thinned(points: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "Q 2"]:
    pieces = np.array_split(points, min(len(points), CURVE_POINTS))
    return np.stack([piece.mean(axis=0) for piece in pieces])


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG; parent folders are created.

    Raises:
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    with written_aside(path) as aside:
        FigureCanvasAgg(figure).figure.savefig(aside, dpi=DPI, format="png")

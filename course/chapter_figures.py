"""Check that every figure of a chapter has titles and axis labels.

`course/build_notebooks.py` installs the check in the kernel that executes a chapter. An incomplete figure stops the
build at its cell.
"""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure


class FigureError(ValueError):
    """A figure without titles or labels."""


def faults(figure: Figure) -> list[str]:
    """List what a figure lacks.

    Every axes needs a title. Every axis with visible numbers needs a label, and so does a colour bar.

    Args:
        figure: The finished figure.

    Returns:
        One sentence per fault; empty if the figure is complete.
    """
    if not figure.axes:
        return ["the figure has no axes"]
    figure.canvas.draw()  # drawing places the ticks
    return [fault for number, axes in enumerate(figure.axes) for fault in _faults_of(number, axes)]


def _faults_of(number: int, axes: Axes) -> list[str]:
    # Twin axes share the title of the axes below them; a colour bar needs none.
    same = [other for other in axes.figure.axes if other.bbox.bounds == axes.bbox.bounds]
    titles = [other.get_title(loc=place).strip() for other in same for place in ("left", "center", "right")]  # type: ignore[arg-type]
    title = next((text for text in titles if text), "")
    found = []
    if not (title or axes.get_label() == "<colorbar>"):
        found.append(f"axes {number} has no title")
    if axes.axison:
        present = [getattr(axes, name) for name in ("xaxis", "yaxis", "zaxis") if hasattr(axes, name)]
        found += [
            f"axes {number} {title!r}: its {axis.axis_name} axis has numbers and no label"
            for axis in present
            if _numbered(axis) and not axis.get_label_text().strip()
        ]
    return found


def _numbered(axis: Axis) -> bool:
    """Return whether an axis shows numbers; inner axes of a shared grid do not."""
    return axis.get_visible() and any(
        label.get_visible() and label.get_text() for label in axis.get_ticklabels()
    )


def install() -> None:
    """Make `matplotlib.pyplot.show` refuse figures with faults."""
    shown = plt.show

    def show(*arguments: Any, **options: Any) -> Any:  # noqa: ANN401
        for number in plt.get_fignums():
            if found := faults(plt.figure(number)):
                raise FigureError("; ".join(found))
        return shown(*arguments, **options)

    plt.show = show

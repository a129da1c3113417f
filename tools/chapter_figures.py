"""What a figure of a chapter has to carry before it may be shown: titles, and names on its axes.

`tools/build_notebooks.py` installs it in the kernel that executes a chapter: a figure that lacks something
stops the build at its cell.
"""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure


class FigureError(ValueError):
    """A figure that a reader could not read."""


def faults(figure: Figure) -> list[str]:
    """Say what a figure lacks.

    Every axes has a title. An axis whose numbers can be seen has a label; a colour bar has one too.

    Args:
        figure: The figure, finished.

    Returns:
        One sentence for each fault; empty for a figure that may be shown.
    """
    if not figure.axes:
        return ["the figure has no axes"]
    figure.canvas.draw()  # ticks are placed when they are drawn
    return [fault for number, axes in enumerate(figure.axes) for fault in _faults_of(number, axes)]


def _faults_of(number: int, axes: Axes) -> list[str]:
    # A twin has the title of the axes that it lies on; a colour bar needs none.
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
    """Say whether an axis shows numbers; inner axes of a shared grid do not."""
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

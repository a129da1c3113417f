"""Put the moving figures into the pages of chapters, below the pictures that stand for them where scripts are off.

The scripts are in docs/site/static/play, their data from `figure_data.py` and `figure_photos.py`. Notebooks do not
contain the figures.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class Figure(NamedTuple):
    """A moving figure.

    Args:
        chapter: Stem of the notebook.
        after: Text of the code cell whose picture the figure follows; no other cell contains it.
        name: Name of the script, and of the figure in it.
        caption: First line of the figure.
        data: Whether the figure has a data script.
        shared: Scripts that it shares with figures of other chapters, in their order.
    """

    chapter: str
    after: str
    name: str
    caption: str
    data: bool = True
    shared: tuple[str, ...] = ()


GPU = ("gpu.js", "screen.js")
"""Scripts of the figures that run the package's kernels."""

FIGURES = (
    Figure("01_points", "distances = (8.0, 4.0, 2.0)", "points", "Walk around the points", data=False),
    Figure("02_gaussians_in_2d", "pushed = [leaning", "ellipse", "Drag a splat", data=False),
    Figure("03_gaussians_in_3d", '"then turned: R S"', "ellipsoid", "Turn a Gaussian", data=False),
    Figure("04_splatting", "the axes zoom in", "tangent", "Drag a Gaussian", data=False),
    Figure("04_splatting", "def by_fisheye", "lens", "Drag a ball across a lens", data=False),
    Figure("05_sort_and_composite", '"the same splats in three orders"', "sphere", "Turn the sphere"),
    Figure("06_spherical_harmonics", "gloss of one splat", "harmonics", "Drag a coefficient", data=False),
    Figure("07_a_trained_scene", '"nothing forgotten": complete', "scene", "Forget a function"),
    Figure("08_fit_an_image", '"its ellipses"', "fit", "Fit the splats, step by step"),
    Figure("09_train_in_3d", "no step of the training saw this view", "training", "Go through the training"),
    Figure("09_train_in_3d", 'title="training loss"', "density", "Move the threshold of densification"),
    Figure("10_the_naive_kernel", '"the kernel, float32"', "naive", "Run the naive kernel", shared=GPU),
    Figure("11_tiles", 'title=f"tiles met:', "tiles", "Drag splats over tiles", shared=GPU),
    Figure("12_the_backward_pass", "a splat adds up its column", "slots", "Who writes where", shared=GPU),
    Figure(
        "13_back_to_the_parameters",
        "L of q = (w, 0, 0, z)",
        "chain",
        "Drag a number of a Gaussian",
        data=False,
    ),
    Figure("14_photos_to_scene", "held_out = sorted(", "wipe", "Wipe between photo and render"),
    Figure("15_cloud_to_surface", "more splats in a wall", "wall", "Move a ray through a wall", data=False),
)

STATIC = "../_static/play/"
STILL = "This figure needs JavaScript. The picture above shows the same without motion."


def behind(figure: Figure, notebook: dict[str, Any]) -> int:
    """Return the index behind the cell of a notebook that a figure follows.

    Raises:
        SystemExit: no code cell, or more than one, has the figure's text.
    """
    places = [
        place
        for place, cell in enumerate(notebook["cells"])
        if cell["cell_type"] == "code" and figure.after in "".join(cell["source"])
    ]
    if len(places) != 1:
        raise SystemExit(f"{figure.chapter}: {len(places)} code cells contain {figure.after!r}, not 1")
    return places[0] + 1


def with_figures(chapter: str, notebook: dict[str, Any]) -> None:
    """Add the figures of a chapter and their scripts.

    Args:
        chapter: Stem of the notebook.
        notebook: The notebook; its cells are changed.

    Raises:
        SystemExit: see `behind`.
    """
    chosen = [figure for figure in FIGURES if figure.chapter == chapter]
    scripts = ["play.js", "algebra.js"] if chosen else []
    scripts += dict.fromkeys(script for figure in chosen for script in figure.shared)
    for figure in chosen:
        notebook["cells"].insert(
            behind(figure, notebook),
            _cell(
                f'<figure class="play" data-play="{figure.name}" data-base="{STATIC}">'
                f"<figcaption>{figure.caption}</figcaption><noscript>{STILL}</noscript></figure>",
                f"figure-{figure.name}",
            ),
        )
        scripts += [f"{figure.name}-data.js"] * figure.data + [f"{figure.name}.js"]
    if scripts:
        tags = "".join(f'<script src="{STATIC}{script}"></script>' for script in scripts)
        notebook["cells"].append(_cell(f"<div>{tags}</div>", "figure-scripts"))


def _cell(html: str, name: str) -> dict[str, Any]:
    return {"cell_type": "markdown", "id": name, "metadata": {}, "source": html}

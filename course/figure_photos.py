"""Write the data of chapter 14's moving figure: docs/site/static/play/wipe-data.js and wipe.jpg.

    python course/figure_photos.py

Executes the chapter's cells with the full budget up to its first trained scene (some minutes), so that the figure
shows the scene that the chapter shows.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import nbformat
import numpy as np
from PIL import Image

from build_notebooks import SOURCES, assembled, execute
from figure_data import OUT, write
from gsplat_edu.evaluate.metrics import psnr
from site_figures import FIGURES, behind

(WIPE,) = (figure for figure in FIGURES if figure.name == "wipe")
"""The figure follows a code cell that defines `held_out`, worst first, `final` and `picture`."""

SIZE = (240, 180)
"""Width and height of a picture, px."""

VIEWS = 3
"""Number of views: from the best of the held-out views to the worst."""

BRIGHTEST = 0.25
"""Mean absolute error of the channels that is drawn white, as in the chapter's pictures."""

LARGEST = 60_000
"""Bytes of wipe.jpg."""

KEEP = """
chosen = [held_out[k] for k in np.linspace(len(held_out) - 1, 0, {views}).round().astype(int)]
np.savez(
    {path!r},
    names=[v.name for v in chosen],
    photos=np.stack([v.image for v in chosen]),
    renders=np.stack([picture(final, v.camera) for v in chosen]),
)
"""
"""A cell that stores what the figure needs."""


def trained(kept: Path) -> None:
    """Execute the chapter up to its first trained scene, and store names, photos and renders in a file.

    Args:
        kept: The file, .npz.

    Raises:
        SystemExit: see `behind`.
    """
    notebook = assembled(SOURCES / f"{WIPE.chapter}.py")
    del notebook.cells[behind(WIPE, notebook) :]
    notebook.cells.append(nbformat.v4.new_code_cell(KEEP.format(views=VIEWS, path=str(kept))))
    execute(notebook)


def strip(photos: np.ndarray, renders: np.ndarray) -> Image.Image:
    """Put the pictures of all views into one: a column each, with photo, render and error below one another.

    Args:
        photos: (N, H, W, 3) bytes.
        renders: (N, H, W, 3) bytes.
    """
    apart = np.abs(renders.astype(float) - photos).mean(axis=-1) / 255
    errors = np.round(255 * np.minimum(apart / BRIGHTEST, 1)).astype(np.uint8)
    made = Image.new("RGB", (len(photos) * SIZE[0], 3 * SIZE[1]))
    for column, layers in enumerate(zip(photos, renders, errors, strict=True)):
        for row, layer in enumerate(layers):
            small = Image.fromarray(layer).resize(SIZE, Image.Resampling.LANCZOS)
            made.paste(small, (column * SIZE[0], row * SIZE[1]))
    return made


def main() -> None:
    """Train, and write the files."""
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "kept.npz"
        trained(kept)
        with np.load(kept) as stored:
            names, photos, renders = (stored[key] for key in ("names", "photos", "renders"))
    views = [
        {"name": str(name), "psnr": round(psnr(render / 255, photo), 2)}
        for name, render, photo in zip(names, renders, photos, strict=True)
    ]
    picture, path = strip(photos, renders), OUT / "wipe.jpg"
    for quality in range(85, 40, -5):
        picture.save(path, quality=quality)
        if path.stat().st_size <= LARGEST:
            break
    print(f"wipe.jpg: {path.stat().st_size / 1e3:.0f} kB at quality {quality}; {views}")
    value = {"width": SIZE[0], "height": SIZE[1], "brightest": BRIGHTEST, "views": views}
    write(WIPE.name, value)


if __name__ == "__main__":
    main()

"""Captures for tests of the page that shows them."""

import dataclasses

import numpy as np

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View


def ring(folder, skipped=(), count=12, **options):
    """Write a capture of a ring of cameras without some of them; return its views."""
    views, points, colors = procedural_capture(size=48, count=count)
    kept = [view for i, view in enumerate(views) if i not in skipped]
    write_colmap(folder, kept, points, colors, binary=False, **options)
    return kept


def measured(folder):
    """Give the points of a capture written as text an error, as if their tracks had been matched."""
    path = folder / "sparse" / "0" / "points3D.txt"
    lines = path.read_text().splitlines()
    rows = [line.split() if line and line[0] != "#" else None for line in lines]
    text = [
        " ".join([*row[:7], "0.5", *row[8:]]) if row else line for row, line in zip(rows, lines, strict=True)
    ]
    path.write_text("\n".join(text) + "\n")


def row(folder):
    """Write a capture of cameras side by side that look the same way."""
    views, points, colors = procedural_capture(size=48, count=4)
    cameras = [
        Camera(
            np.eye(3),
            (i, 0.0, -3.0),
            **{k: getattr(view.camera, k) for k in ("fx", "fy", "cx", "cy", "H", "W")},
        )
        for i, view in enumerate(views)
    ]
    write_colmap(
        folder, [View(c, v.image, name=v.name) for c, v in zip(cameras, views, strict=True)], points, colors
    )


def replaced_lens(frame, **values):
    """Return a frame with another lens."""
    return dataclasses.replace(frame, lens=dataclasses.replace(frame.lens, **values))

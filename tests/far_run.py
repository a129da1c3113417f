"""A run far from zero, shared by the tests of `gsplat-edu render`."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.io.ply import save_ply
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.scene.views import View
from splats import splats_on

ORIGIN = (512.0, -64.0, 8.0)
BLUE = (0.0, 0.0, 1.0)


def write_far_run(root: Path) -> tuple[RunFolder, Path, Path, Sequence[View]]:
    """Write a run whose scene lies at `ORIGIN`, with a blue background.

    Returns:
        The run; its capture; its scene near zero, `bare.ply`; and the views near zero, four for training and two held
        out.
    """
    views, points, colors = procedural_capture(size=32, count=6)
    write_colmap(root / "capture", views, points, colors)
    gaussians = splats_on(points, colors)
    folder = RunFolder(root / "run")
    folder.write_config(
        {"render": dataclasses.asdict(RenderSettings(background=BLUE)), "origin": list(ORIGIN), "data": {}}
    )
    save_ply(folder.scene(30), gaussians, ORIGIN)
    folder.write_cameras(views[:4], views[4:], ORIGIN)
    save_ply(root / "bare.ply", gaussians)
    return folder, root / "capture", root / "bare.ply", views

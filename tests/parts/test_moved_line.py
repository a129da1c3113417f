"""The line about things that moved, at the end of a training."""

from dataclasses import replace

from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.parts.run_values import Ended
from gsplat_edu.parts.transients.findings import moved_line
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points


def test_photos_outside_memory_are_not_compared_but_the_command_is_named(tmp_path):
    views, points, colors = procedural_capture(24, 6)
    write_colmap(tmp_path, views, points, colors)
    dataset = load_dataset(tmp_path, DataSettings(image_memory=0))
    absent = replace(dataset, train=())  # no photos to compare
    start = from_points(points, colors, recipe(5))
    line = moved_line(Ended(tmp_path / "run", start, absent, render, RenderSettings()))
    assert line == f"to find photos that do not fit the scene: gsplat-edu doctor {tmp_path / 'run'}"
    assert moved_line(Ended(tmp_path / "run", start, load_dataset(tmp_path), render, RenderSettings())) == ""
    line = moved_line(Ended(tmp_path / "run", start, load_dataset(tmp_path), None, RenderSettings()))
    assert line == f"to find photos that do not fit the scene: gsplat-edu doctor {tmp_path / 'run'}"

"""What a finished training says about things that moved."""

from dataclasses import replace

from gsplat_edu.data.dataset import DataSettings, load_dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.doctor.moving import moved_line
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.train.config import recipe
from gsplat_edu.train.initialize import from_points


def test_photos_outside_memory_are_not_read_again(tmp_path):
    views, points, colors = procedural_capture(24, 6)
    write_colmap(tmp_path, views, points, colors)
    dataset = load_dataset(tmp_path, DataSettings(image_memory=0))
    absent = replace(dataset, train=())  # nothing to compare: only the command is left to say
    start = from_points(points, colors, recipe(5))
    line = moved_line(tmp_path / "run", start, absent, render, RenderSettings())
    assert line == f"to find photos that do not fit the scene: gsplat-edu doctor {tmp_path / 'run'}"
    assert moved_line(tmp_path / "run", start, load_dataset(tmp_path), render, RenderSettings()) == ""

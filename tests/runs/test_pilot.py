"""The choice of `--refine auto`."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.runs import pilot
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.pilot import LEAST_GAIN, refinement_for
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import recipe


def options(folder, tmp_path, **data):
    return RunOptions(folder, tmp_path / "run", recipe(100, strategy="fast"), DataSettings(**data))


def shaken(view, rng):
    """Return the view with a pose that is wrong by about 2 degrees and 2 % of the distance."""
    twist = torch.from_numpy(rng.normal(size=6) * ([0.02] * 3 + [0.05] * 3))
    return View(CameraTensors.of(view.camera).moved(twist).value(), view.image, name=view.name)


@pytest.mark.sliced(1, group="quality that comes back")
@pytest.mark.parametrize("wrong", [False, True])
def test_poses_are_refined_if_they_are_wrong(tmp_path, monkeypatch, wrong):
    monkeypatch.setattr(pilot, "PILOT_STEPS", 250)
    views, points, colors = procedural_capture(48, 24, splats=150)
    rng = np.random.default_rng(0)
    views = [shaken(view, rng) for view in views] if wrong else views
    write_colmap(tmp_path / "capture", views, points, colors)
    steps = []
    reader = CaptureReader(tmp_path / "capture")
    chosen, reason = refinement_for(options(reader.path, tmp_path), reader, lambda: steps.append(1))
    assert len(steps) == 3 * 250
    assert (chosen != "none") == wrong, reason
    assert "dB with none" in reason and "dB with both" in reason
    assert not (tmp_path / "run").exists()


def test_the_smallest_refinement_without_a_clearly_better_one_is_chosen():
    def chosen(none, poses, both):
        return pilot._choice({"none": none, "poses": poses, "both": both})[0]

    assert chosen(20.0, 20.0 + 0.9 * LEAST_GAIN, 20.0) == "none"
    assert chosen(20.0, 20.0 + 1.1 * LEAST_GAIN, 20.0) == "poses"
    assert chosen(20.0, 20.0 + 1.1 * LEAST_GAIN, 20.0 + 1.9 * LEAST_GAIN) == "poses"
    assert chosen(20.0, 20.0, 20.0 + 1.1 * LEAST_GAIN) == "both"
    assert chosen(20.0, 19.0, 19.0) == "none"


def test_without_held_out_photos_nothing_is_refined(tmp_path):
    write_colmap(tmp_path / "capture", *procedural_capture(24, 6, splats=60))
    reader = CaptureReader(tmp_path / "capture")
    assert refinement_for(options(reader.path, tmp_path, test_every=0), reader) == (
        "none",
        "no photos are held out to judge by",
    )


def test_pilots_have_the_settings_of_the_run():
    config = replace(recipe(100), background=(1.0, 1.0, 1.0), antialiased=True, max_gaussians=500, seed=3)
    made = pilot._config(config, "poses")
    assert (made.background, made.antialiased, made.max_gaussians, made.seed) == (
        (1.0, 1.0, 1.0),
        True,
        500,
        3,
    )
    assert (made.strategy, made.refine, made.iterations) == ("fast", "poses", pilot.PILOT_STEPS)

"""The choice of `--refine auto`."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import panorama_room
from gsplat_edu import Camera
from gsplat_edu.budget.deadline import Deadline, TrialTime
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.parts import bench
from gsplat_edu.parts.poses import choice
from gsplat_edu.parts.poses.choice import LEAST_GAIN
from gsplat_edu.parts.poses.part import POSES
from gsplat_edu.parts.poses.trials import CONTROL, RefineTrials
from gsplat_edu.parts.run_values import Tried
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.pilot import chosen_by_pilots
from gsplat_edu.scene.projection import Distortion, Projection
from gsplat_edu.scene.shutter import RollingShutter
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import recipe
from lab.captures.lens_captures import LENS_SCENES, lens_photos, nearer
from lens_captures import moving_photo, room_cameras


def options(folder, tmp_path, **data):
    return RunOptions(folder, tmp_path / "run", recipe(100, strategy="fast"), DataSettings(**data))


def shaken(view, rng):
    """Return the view with a pose that is wrong by about 2 degrees and 2 % of the distance."""
    twist = torch.from_numpy(rng.normal(size=6) * ([0.02] * 3 + [0.05] * 3))
    return View(CameraTensors.of(view.camera).moved(twist).value(), view.image, name=view.name)


def write_garden(folder, k1):
    """Photograph the garden by wide cameras with a distortion, and write them as pinholes."""
    scene = LENS_SCENES["garden"]
    given = [
        Camera.posed(c.R, c.eye, replace(c.intrinsics, fx=48.0, fy=48.0))
        for c in (nearer(camera, scene.target) for camera in scene.cameras(48, (96, 72)))
    ]
    true = [c.through(Projection(distortion=Distortion.of(k1=k1))) if k1 else c for c in given]
    capture = lens_photos("garden", true, given, 4_000, np.random.default_rng(0))
    views = [View(c, view.image, name=view.name) for c, view in zip(given, capture.views, strict=True)]
    write_colmap(folder, views, capture.points, capture.colors)


def write_moving_room(folder, pixels):
    """Photograph the room by cameras that turn while they are read, and write them at rest."""
    rng, views = np.random.default_rng(1), []
    for i, camera in enumerate(room_cameras(Projection(), 24, 80)):
        focal, axis = 64.0, rng.normal(size=3)
        given = Camera.posed(camera.R, camera.eye, replace(camera.intrinsics, fx=focal, fy=focal))
        shutter = RollingShutter(pixels / focal * axis / np.linalg.norm(axis), (0, 0, 0))
        views.append(View(given, moving_photo(given.through(shutter=shutter)), name=f"{i:02}.png"))
    rng = np.random.default_rng(0)
    points = [
        c + rng.random((200, 1)) * a + rng.random((200, 1)) * b for c, a, b in panorama_room.rectangles()
    ]
    write_colmap(folder, views, np.concatenate(points), np.full((len(points) * 200, 3), 0.5))


def chosen_for(folder, tmp_path, lens):
    """Return the choice for a capture, and how many pilots were trained."""
    steps = []
    chosen = chosen_by_pilots(
        POSES, options(folder, tmp_path, lens=lens), CaptureReader(folder), steps.append
    )
    assert len(steps) % bench.PILOT_STEPS == 0
    return chosen.value, chosen.reason, RefineTrials.of(chosen.record), len(steps) // bench.PILOT_STEPS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("k1", "kept"),
    [
        (-0.1, {"lens", "poses+lens"}),
        pytest.param(0.0, {"none", "poses"}, marks=pytest.mark.soak),
    ],
)
def test_a_lens_is_learned_if_it_is_wrong(tmp_path, k1, kept):
    """One that does not gain is trained on from what it found, before it is left out.

    Whether the exact poses are refined too is a tie at `LEAST_GAIN`, which instruction sets round to either side.
    """
    write_garden(tmp_path / "capture", k1)
    chosen, reason, trials, trained = chosen_for(tmp_path / "capture", tmp_path, "native")
    assert chosen in kept, reason
    assert any(name.endswith(CONTROL) for name in trials.posed) and "lens" in reason
    assert trained - len(trials.posed) in ({0, 1} if k1 else {1})
    assert ("trained on" in reason) == (trained > len(trials.posed))


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [12.0, pytest.param(0.0, marks=pytest.mark.soak)])
def test_a_shutter_is_learned_if_photos_have_one(tmp_path, pixels):
    """Photos without one give no sign of it, so no training with a motion is spent on them."""
    write_moving_room(tmp_path / "capture", pixels)
    chosen, reason, trials, trained = chosen_for(tmp_path / "capture", tmp_path, "undistort")
    assert chosen == ("shutter" if pixels else "none"), reason
    assert ("shutter" in trials.moving) == bool(pixels)
    assert set(trials.posed) >= set(choice.ORDER) and "lens" not in trials.posed
    assert trained == len(trials.posed)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [False, True])
def test_poses_are_refined_if_they_are_wrong(tmp_path, monkeypatch, wrong):
    monkeypatch.setattr(bench, "PILOT_STEPS", 250)
    views, points, colors = procedural_capture(48, 24, splats=150)
    rng = np.random.default_rng(0)
    views = [shaken(view, rng) for view in views] if wrong else views
    write_colmap(tmp_path / "capture", views, points, colors)
    steps = []
    reader = CaptureReader(tmp_path / "capture")
    found = chosen_by_pilots(POSES, options(reader.path, tmp_path), reader, steps.append)
    chosen, reason, trials = found.value, found.reason, RefineTrials.of(found.record)
    assert len(steps) == len(trials.posed) * 250 and steps[0] == 3 * 250
    assert (chosen != "none") == wrong, reason
    assert "dB with none" in reason and "dB with both" in reason
    assert not (tmp_path / "run").exists()


def test_the_smallest_refinement_without_a_clearly_better_one_is_chosen():
    def chosen(none, poses, both):
        return choice._smallest({"none": none, "poses": poses, "both": both}, choice.ORDER)

    assert chosen(20.0, 20.0 + 0.9 * LEAST_GAIN, 20.0) == "none"
    assert chosen(20.0, 20.0 + 1.1 * LEAST_GAIN, 20.0) == "poses"
    assert chosen(20.0, 20.0 + 1.1 * LEAST_GAIN, 20.0 + 1.9 * LEAST_GAIN) == "poses"
    assert chosen(20.0, 20.0, 20.0 + 1.1 * LEAST_GAIN) == "both"
    assert chosen(20.0, 19.0, 19.0) == "none"


@pytest.mark.parametrize("asked", ["", "poses"])
def test_pilots_end_early_if_they_would_take_too_much_of_a_time_limit(tmp_path, asked):
    """Each of 1,800 steps takes a second by the clock, of a limit of 1,000 s."""
    write_colmap(tmp_path / "capture", *procedural_capture(32, 8, splats=60))
    reader, steps = CaptureReader(tmp_path / "capture"), []
    time = TrialTime(Deadline(1_000.0, lambda: float(len(steps))))
    found = chosen_by_pilots(POSES, options(reader.path, tmp_path), reader, steps.append, asked, time.is_over)
    assert (found.value, found.record) == (asked or "none", {})
    assert "more than a quarter of the time that is left" in found.reason
    assert 0 < len(steps) < 50, "the pace tells long before 250 s"
    late = TrialTime(Deadline(1_000.0, lambda: 1_001.0))
    steps.clear()
    assert (
        chosen_by_pilots(POSES, options(reader.path, tmp_path), reader, steps.append, asked, late.is_over)
        == found
    )
    assert not steps


def test_without_held_out_photos_nothing_is_refined(tmp_path):
    write_colmap(tmp_path / "capture", *procedural_capture(24, 6, splats=60))
    reader = CaptureReader(tmp_path / "capture")
    assert chosen_by_pilots(POSES, options(reader.path, tmp_path, test_every=0), reader) == Tried(
        "none", "no photos are held out to judge by"
    )


def test_pilots_have_the_settings_of_the_run():
    config = replace(recipe(100), background=(1.0, 1.0, 1.0), antialiased=True, max_gaussians=500, seed=3)
    made = bench.pilot_config(config, refine="poses")
    assert (made.background, made.antialiased, made.max_gaussians, made.seed) == (
        (1.0, 1.0, 1.0),
        True,
        500,
        3,
    )
    assert (made.strategy, made.refine, made.iterations) == ("fast", "poses", bench.PILOT_STEPS)

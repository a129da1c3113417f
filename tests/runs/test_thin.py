"""Captures of few photos get trials; if longer trials score worse on unseen photos, the run is shorter."""

import dataclasses
import itertools
import shutil

import numpy as np
import pytest

from gsplat_edu.budget.deadline import Deadline
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.data.dataset import DataSettings
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.runs import thin
from gsplat_edu.runs.thin import ThinTrial, longest_of, needs_trial, try_lengths
from gsplat_edu.runs.training import RunOptions
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import recipe

COUNT = 10


def turned(camera, angle):
    """Rotate a camera about its vertical axis."""
    s, c = np.sin(angle), np.cos(angle)
    return Camera.posed(
        np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ camera.R, camera.eye, camera.intrinsics
    )


def capture(folder, error):
    """Write ten photos whose cameras are rotated by an error, radians, alternately to the right and to the left."""
    views, *rest = procedural_capture(size=64, count=COUNT)
    moved = [
        View(turned(view.camera, error if i % 2 else -error), view.read().image, name=view.name)
        for i, view in enumerate(views)
    ]
    write_colmap(folder, moved, *rest)
    return folder


@pytest.fixture(scope="module", params=[0.0, 0.06], ids=["exact", "wrong"])
def given(request, tmp_path_factory):
    folder = capture(tmp_path_factory.mktemp("capture"), request.param)
    config = recipe(1_000, strategy="fast", sh_degree=3)
    options = RunOptions(folder, folder / "run", config, DataSettings(test_every=0))
    return request.param, options, CaptureReader(folder)


@pytest.mark.slow
def test_wrong_poses_shorten_a_training_and_exact_poses_do_not(given, monkeypatch):
    error, options, reader = given
    steps = []
    trial = try_lengths(options, reader, lambda: steps.append(1))
    assert trial.judges == 2 and len(steps) == sum(trial.scores)
    if error:
        assert trial.longest is not None and trial.scores[max(trial.scores)] < trial.scores[trial.longest]
        assert "2 training photos" in str(trial) and "check the poses" in str(trial)
    else:
        assert trial.longest is None and list(trial.scores) == list(thin.LENGTHS) and str(trial) == ""


def test_sharp_details_out_of_place_are_trained_longer_than_the_best_psnr():
    """PSNR says whether a training ends early, shifted PSNR where."""
    shifted = {100: 22.0, 200: 23.0, 400: 22.9, 800: 22.0}
    scores = {100: 20.0, 200: 19.7, 400: 19.4, 800: 19.6}
    assert longest_of(scores, shifted) == 200
    said = str(ThinTrial(200, scores, 2))
    assert "20.0 dB after 100 iterations and 19.4 dB after 400; 200 show most detail" in said
    assert longest_of(scores | {400: 19.6}, shifted) is None  # no fall of 0.45 dB
    assert longest_of(scores | {800: 20.1}, shifted) is None  # a longer training makes the fall good
    assert longest_of({}, {}) is None
    assert "most detail" not in str(ThinTrial(100, scores, 2))


def test_the_plan_follows_the_trial_and_gives_the_reason(given, monkeypatch):
    _, options, reader = given
    monkeypatch.setattr(
        "gsplat_edu.budget.length.try_lengths", lambda *_: ThinTrial(200, {200: 20.0, 400: 19.0}, 2)
    )
    found = plan(options, Limits(), reader=reader, quality="standard")
    assert found.iterations == 200 and found.options.config.fast.stop == 120, (
        "the schedule has the length of the run"
    )
    assert "standard is 200 iterations (longer trainings make photos worse" in found.sentences[0]
    assert "20.0 dB after 200 iterations and 19.0 dB after 400" in found.sentences[0]
    stayed = plan(options, Limits(), ["fast_stop"], reader=reader, quality="standard")
    assert stayed.options.config.fast.stop == options.config.fast.stop


def test_only_captures_of_few_photos_that_start_from_points_are_tried(given, monkeypatch):
    _, options, reader = given
    assert [needs_trial(views) for views in (1, 3, 4, 29, 30)] == [False, False, True, True, False]

    def refuse(*_):
        raise AssertionError("tried")

    monkeypatch.setattr("gsplat_edu.budget.length.try_lengths", refuse)
    with pytest.raises(AssertionError, match="tried"):
        plan(options, Limits(), reader=reader, quality="draft")
    assert plan(options, Limits(), reader=reader).iterations == 1_000
    resumed = dataclasses.replace(options, resume=True)
    assert plan(resumed, Limits(), reader=reader, quality="draft").iterations == 1_000
    shutil.rmtree(options.out, ignore_errors=True)


@pytest.mark.parametrize("longest", [100, None])
def test_a_time_limit_does_not_train_longer_than_the_trial(given, monkeypatch, longest):
    _, options, reader = given
    trial = ThinTrial(longest, {100: 20.0, 200: 19.0}, 2)
    monkeypatch.setattr("gsplat_edu.budget.length.try_lengths", lambda *_: trial)
    generous = Limits(time=Deadline(36_000.0, lambda: 1.0))  # however slow this machine is now
    found = plan(options, generous, reader=reader)
    said = [sentence for sentence in found.sentences if "before the limit" in sentence]
    if longest is None:
        assert found.by_time and found.iterations > 1_000 and not said
    else:
        assert found.iterations == longest and not found.by_time and found.profile is None
        assert "longer trainings make photos worse" in said[0]
    assert plan(options, generous, ["iterations"], reader=reader).iterations == options.config.iterations


def test_a_trial_is_judged_on_the_background_of_the_run(given, monkeypatch):
    _, options, reader = given
    monkeypatch.setattr("gsplat_edu.runs.thin.LENGTHS", (1,))
    scores = []
    for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)):
        config = options.config.changed(background=background)
        scores.append(try_lengths(dataclasses.replace(options, config=config), reader).scores[1])
    assert scores[0] != scores[1]


@pytest.mark.slow
def test_trials_end_after_a_quarter_of_the_time(given):
    _, options, reader = given
    seconds = itertools.count()  # every look at the clock takes a second, and there is one per iteration
    found = plan(options, Limits(time=Deadline(600.0, lambda: float(next(seconds)))), reader=reader)
    assert any("a quarter of the time did not suffice" in sentence for sentence in found.sentences)
    assert next(seconds) < 250 and found.by_time
    calls = itertools.count()
    trial = try_lengths(options, reader, is_over=lambda: next(calls) >= 150)
    assert trial.cut and list(trial.scores) == [100] and trial.longest is None

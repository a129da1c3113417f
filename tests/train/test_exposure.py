"""Photos of unequal exposure: the gains come back, the gauge holds, and a resumed run has the same bits."""

import functools
import json

import numpy as np
import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.exposure import stops
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.config import recipe
from gsplat_edu.train.exposure import NAME
from gsplat_edu.train.initialize import from_points, make_strategy, make_view_model
from gsplat_edu.train.trainer import StepParts, Trainer
from gsplat_edu.views import View
from test_exposure import photographed

COUNT, HELD_OUT = 10, 8
GREY = (0.4, 0.4, 0.4)
"""Background: on black, most of a small procedural photo would not count."""


@pytest.fixture(scope="module")
def capture():
    """Ten views of 48 px before grey, their points, and the same views with drawn exposures and tints."""
    views, points, colors = procedural_capture(64, COUNT, splats=120)
    grey = [View(v.camera, np.maximum(v.read().image, 90), name=v.name) for v in views]
    rng = np.random.default_rng(5)
    scales = 2.0 ** rng.uniform(-0.7, 0.7, (COUNT, 1)) * rng.uniform(0.85, 1.15, (COUNT, 3))
    uneven = [
        View(v.camera, photographed(v.read().image / 255.0, scale), name=v.name)
        for v, scale in zip(grey, scales, strict=True)
    ]
    return grey, uneven, points, colors, scales


def trainer(capture, views, appearance, iterations=400):
    config = recipe(iterations, strategy="fast", max_gaussians=600, appearance=appearance, sh_degree=1)
    config = config.changed(background=GREY)
    start = from_points(*capture[2:4], config)
    return Trainer(
        start,
        views,
        config,
        render=functools.partial(render),
        extent=2.0,
        density=make_strategy(config, 2.0, start),
        parts=StepParts(view_model=make_view_model(config, len(views), start.means)),
    )


def fitted(run, views):
    shown = RenderSettings(background=GREY)
    scores = score_views(run.gaussians, views, lambda g, c: render(g, c, settings=shown), GREY)
    return summarize(scores)["psnr_fitted"]


def test_exposures_come_back_and_the_held_out_quality_with_them(capture):
    grey, uneven, *_, scales = capture
    kept = slice(0, HELD_OUT)
    plain, lost, regained = (
        trainer(capture, views[kept], appearance)
        for views, appearance in ((grey, "none"), (uneven, "none"), (uneven, "exposure"))
    )
    for run in (plain, lost, regained):
        run.run()
    found = stops(regained._parts.view_model.log_gains()).numpy()
    wanted = np.log2(scales[kept])
    wanted = wanted - wanted.mean(axis=0)
    # Differences of up to 1.4 stops. A scene of 64 px in 400 steps leaves errors of some per cent.
    assert np.abs(found - wanted).max() < 0.15 and np.sqrt(np.mean((found - wanted) ** 2)) < 0.06
    best, worst, ours = (fitted(run, grey[HELD_OUT:]) for run in (plain, lost, regained))
    assert best - worst > 1.0, "the exposures harm"
    assert ours - worst > 0.9 * (best - worst)


def test_the_mean_correction_is_the_identity(capture):
    run = trainer(capture, capture[1], "exposure", 30)
    run.run()
    model = run._parts.view_model
    assert model.log_gains().abs().max() > 0.1
    # A mean of ten float32 numbers below 1 rounds by less than 1e-6.
    assert model.log_gains().mean(dim=0).abs().max() < 1e-6


@pytest.mark.parametrize("at", [1, 17])
def test_a_resumed_run_has_the_same_bits_for_any_number_of_threads(capture, tmp_path, at):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole = trainer(capture, capture[1], "exposure", 40)
        whole.run()
        first, second = (trainer(capture, capture[1], "exposure", 40) for _ in range(2))
        torch.set_num_threads(5)
        first.run(lambda: first.iteration >= at)
        load_checkpoint(save_checkpoint(tmp_path, first, 1.0), second)
        torch.set_num_threads(2)
        second.run()
    finally:
        torch.set_num_threads(before)
    (tensors, numbers), (resumed, others) = whole.state(), second.state()
    assert json.dumps(numbers) == json.dumps(others) and f"view_model.{NAME}" in tensors
    for name, tensor in tensors.items():
        assert torch.equal(tensor, resumed[name]), name

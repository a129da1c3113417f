"""Vignetting: dark corners are recovered, photos of one lens are corrected equally, and the mean is fixed."""

import numpy as np
import pytest
import torch

from doctor.rooms import room
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.ops.exposure import falloff
from gsplat_edu.ops.recolor import recolored_natively
from gsplat_edu.parts.exposure.model import NAME, VIGNETTING_ERROR, Exposure
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.views import View
from gsplat_edu.train.feed import Target
from gsplat_edu.train.view_model import ViewRender
from test_exposure import photographed
from train.test_exposure import trainer

HELD_OUT = slice(3, None, 6)


@pytest.fixture(scope="module")
def capture():
    """Views of 64 px in a room, with dark corners unless held out; points; and the true k of each view."""
    clean, points = room("orbit", 64)
    views: tuple[list[View], list[View]] = [], []
    ks = np.random.default_rng(5).uniform(-0.5, 0.0, len(clean))
    for i, (view, k) in enumerate(zip(clean, ks, strict=True)):
        image, (H, W) = view.read().over((0.0, 0.0, 0.0)), (view.camera.H, view.camera.W)
        image = image / 255.0 if image.dtype == np.uint8 else image
        plane = falloff(torch.tensor(k, dtype=torch.float64), H, W).numpy()[..., None]
        scales = np.ones(3) if i in range(len(clean))[HELD_OUT] else plane**2.4
        for made, scale in zip(views, (np.ones(3), scales), strict=True):
            made.append(View(view.camera, photographed(image, scale), name=view.name))
    return *views, points, np.full((len(points), 3), 0.5), ks


def score(run, views):
    def shown(gaussians, camera):
        return render(gaussians, camera, settings=RenderSettings(jacobian_limit=run.config.jacobian_limit))

    return summarize(score_views(run.gaussians, views, shown, (0.0, 0.0, 0.0)))["psnr_fitted"]


@pytest.mark.slow
def test_dark_corners_are_corrected_and_held_out_quality_with_them(capture):
    clean, dark, *_, ks = capture
    held_out = clean[HELD_OUT]
    kept = [i for i, view in enumerate(clean) if view not in held_out]
    plain, lost, regained = (
        trainer(capture, [views[i] for i in kept], appearance, 800)
        for views, appearance in ((clean, "exposure"), (dark, "exposure"), (dark, "vignetting"))
    )
    for run in (plain, lost, regained):
        run.run()
    found, wanted = regained.view_model.vignetting().numpy(), ks[kept]
    # 560 steps with measurements of 20 photos of 64 px recover two thirds of the depth, in the right order.
    assert np.corrcoef(found, wanted)[0, 1] > 0.7
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.6 * np.sqrt(np.mean(wanted**2))
    best, worst, ours = (score(run, held_out) for run in (plain, lost, regained))
    assert best - worst > 1.0, "dark corners reduce the quality"
    assert ours - worst > 0.5 * (best - worst)


def model_with(ks, measured=None):
    model = Exposure(len(ks), 100, torch.zeros(1, dtype=torch.float64), recolored_natively, vignetting=True)
    state = model.parameters()[NAME]
    state[:, 3] = torch.tensor(ks)
    state[:, 4] = torch.ones(len(ks)) if measured is None else torch.tensor(measured)
    return model


def test_only_photos_of_one_lens_are_corrected_equally():
    alike = model_with([-0.3, -0.3 + VIGNETTING_ERROR, -0.3 - VIGNETTING_ERROR, -0.3]).vignetting()
    np.testing.assert_allclose(alike.numpy(), -0.3, atol=1e-12)
    apart = np.array([-0.6, -0.1, -0.2, -0.4])
    found = model_with(apart).vignetting().numpy()
    share = 1 - VIGNETTING_ERROR**2 / apart.var()
    np.testing.assert_allclose(found, apart.mean() + share * (apart - apart.mean()), rtol=1e-12)


def test_a_photo_that_was_not_measured_has_the_mean_of_the_others():
    np.testing.assert_allclose(model_with([-0.6, 0.0, -9.0], [2.0, 1.0, 0.0]).vignetting()[2].item(), -0.3)
    assert model_with([0.4, 0.1, 0.3]).vignetting().tolist() == [0.0] * 3, "no lens makes corners brighter"
    assert model_with([9.0, 9.0], [0.0, 0.0]).vignetting().tolist() == [0.0, 0.0]
    assert Exposure(2, 100, torch.zeros(1), recolored_natively).vignetting().tolist() == [0.0, 0.0]


def test_the_mean_correction_is_the_identity():
    """Corrections multiply x + 0.055 by factors whose geometric mean over photos and pixels is 1."""
    model = model_with([-0.6, -0.1, 0.0, -0.4])
    model.parameters()[NAME][:, :3] = torch.randn(4, 3, dtype=torch.float64) / 5
    image = torch.full((12, 17, 3), 0.5, dtype=torch.float64)
    target = Target(torch.full((12, 17, 3), 99, dtype=torch.uint8), None)
    given = ViewRender(image, torch.zeros(12, 17, dtype=torch.float64), (0.0, 0.0, 0.0))
    rows = [{NAME: row} for row in model.parameters()[NAME]]
    found = [model.correct(i, given, target, rows[i]) for i in range(4)]
    logs = [torch.log((one + 0.055) / (image + 0.055)) for one in found]
    assert torch.stack(logs).abs().max() > 0.1
    np.testing.assert_allclose(torch.stack(logs).mean(dim=(0, 1, 2)).numpy(), 0.0, atol=1e-12)

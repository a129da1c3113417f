"""Exposure of photos that are not opaque: trainings, scores and other uses correct only the object."""

import numpy as np
import pytest
import torch

from gsplat_edu.data import procedural
from gsplat_edu.evaluate.metrics import at_exposure_of, psnr_fitted, score_views, summarize, transparency_of
from gsplat_edu.ops.exposure import stops
from gsplat_edu.ops.recolor import recolored_natively
from gsplat_edu.parts.exposure.model import Exposure
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.feed import Target
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.view_model import ViewRender
from test_exposure import photographed

GREY = (0.55, 0.5, 0.45)
HELD_OUT = slice(3, None, 6)


@pytest.fixture(scope="module")
def capture():
    """Views of 64 px with alpha, the same views with random exposures and tints, points, and the random factors."""
    even, points, colors = procedural.procedural_capture(64, 16, splats=300)
    scene = procedural.egg_splats(np.random.default_rng(0), 300)
    rng = np.random.default_rng(5)
    scales = 2.0 ** rng.uniform(-0.7, 0.7, (16, 1)) * rng.uniform(0.85, 1.15, (16, 3))
    views: tuple[list[View], list[View]] = [], []
    for view, scale in zip(even, scales, strict=True):
        image, transmittance = procedural.render_gaussians(view.camera, *scene)
        opacity = 1.0 - transmittance
        straight = np.clip(image / np.maximum(opacity, 1e-6)[..., None], 0, 1)
        alpha = np.round(255 * opacity).astype(np.uint8)
        for made, factor in zip(views, (np.ones(3), scale), strict=True):
            made.append(View(view.camera, photographed(straight, factor), alpha=alpha, name=view.name))
    return *views, points, colors, scales


def shown(gaussians, camera):
    return render(gaussians, camera, settings=RenderSettings(background=GREY))


def trained(capture, views, appearance):
    config = recipe(
        400, strategy="fast", max_gaussians=3_000, appearance=appearance, sh_degree=1, background=GREY
    )
    start = from_points(*capture[2:4], config)
    run = training(config, Views(views), load_backend("cpu"), Start(start, extent=2.0))
    run.run()
    return run


@pytest.mark.slow
def test_exposures_of_transparent_photos_are_recovered(capture):
    even, uneven, *_, scales = capture
    held_out = even[HELD_OUT]
    kept = [i for i, view in enumerate(even) if view not in held_out]
    plain, lost, regained = (
        trained(capture, [views[i] for i in kept], appearance)
        for views, appearance in ((even, "none"), (uneven, "none"), (uneven, "exposure"))
    )
    found = stops(regained.view_model.log_gains()).numpy()
    wanted = np.log2(scales[kept])
    wanted = wanted - wanted.mean(axis=0)
    # As for opaque photos, 400 steps at 64 px leave errors of a tenth of the differences of up to 1.4 stops.
    assert np.abs(found - wanted).max() < 0.3 and np.sqrt(np.mean((found - wanted) ** 2)) < 0.15
    best, worst, ours = (
        summarize(score_views(run.gaussians, held_out, shown, GREY))["psnr_fitted"]
        for run in (plain, lost, regained)
    )
    assert best - worst > 1.0, "uncorrected exposures reduce the quality"
    assert ours - worst > 0.7 * (best - worst)


def test_gradients_pass_through_the_view_model_to_image_and_transmittance():
    """In float64. With measured gains, the model is linear in both, and no value is clipped, as the photo is below
    255."""
    generator = torch.Generator().manual_seed(2)
    model = Exposure(2, 100, torch.zeros(1, dtype=torch.float64), recolored_natively)
    model.parameters()["exposures"][:, :3] = torch.tensor([[0.2, 0.1, 0.0], [-0.2, 0.0, 0.1]])
    image, transmittance = (
        torch.rand(*shape, generator=generator, dtype=torch.float64).requires_grad_()
        for shape in ((8, 9, 3), (8, 9))
    )
    target = Target(torch.full((8, 9, 3), 99, dtype=torch.uint8), None, torch.ones(8, 9, dtype=torch.bool))
    rows = {"exposures": model.parameters()["exposures"][0]}
    assert torch.autograd.gradcheck(
        lambda x, t: model.correct(0, ViewRender(x, t, GREY), target, rows), (image, transmittance)
    )


def test_gains_are_measured_where_photo_and_render_are_opaque():
    """A floater in front of the background is no part of the object and does not change the gains."""
    rng = np.random.default_rng(3)
    colors = torch.from_numpy(rng.uniform(0.2, 0.6, (20, 24, 3))).float()
    photo = torch.from_numpy(photographed(colors.numpy(), np.full(3, 1.5)))
    opaque = torch.zeros(20, 24, dtype=torch.bool)
    opaque[:, :8] = True
    photo[:, 8:] = 140
    target = Target(photo, None, opaque)
    model = Exposure(2, 100, colors, recolored_natively)
    before = model.parameters()["exposures"].clone()
    rows = model.measure(0, ViewRender(colors, torch.zeros(20, 24), GREY), target, 50)
    assert torch.equal(model.parameters()["exposures"], before), "measuring does not change the state"
    model.parameters()["exposures"][0] = rows["exposures"]
    # half of the gain, because the mean over the two photos is subtracted; bytes round by 1/255
    np.testing.assert_allclose(stops(model.log_gains())[0].numpy(), np.log2(1.5) / 2, atol=0.01)


def darker_render(scale):
    """Return a photo with alpha, a render of it at another exposure over a background, and the transmittance."""
    rng = np.random.default_rng(6)
    straight, opacity = rng.uniform(0.2, 0.6, (30, 40, 3)), np.ones((30, 40))
    opacity[:12] = 0.0
    opacity[12:15] = 0.5
    photo = Photo(photographed(straight, np.full(3, scale)), np.round(255 * opacity).astype(np.uint8))
    share = opacity[..., None]
    image = torch.from_numpy(straight * share + np.array(GREY) * (1 - share))
    none = torch.zeros(0, dtype=torch.int64)
    output = RenderOutput(
        image, torch.from_numpy(1 - opacity), None, none, torch.zeros(0, 2), None, lambda: none
    )
    return photo, output


def test_scores_fit_the_object_and_leave_the_background():
    photo, output = darker_render(1.6)
    truth = photo.over(GREY)
    given = transparency_of(photo, output, GREY)
    # Camera and compositing round to bytes, together by at most 1/255, so at least 48 dB.
    assert psnr_fitted(output.image, truth, None, given) > 48
    assert psnr_fitted(output.image, truth) < 30, "without the transparency, the background is fitted too"
    found = at_exposure_of(truth, output.image, None, given)
    np.testing.assert_allclose(found.numpy(), truth / 255.0, atol=1.5 / 255)
    assert transparency_of(Photo(truth), output, GREY) is None


def test_photos_converted_to_the_scenes_exposure_keep_their_alpha(tmp_path):
    from gsplat_edu.data.dataset import load_dataset
    from gsplat_edu.data.settings import DataSettings
    from gsplat_edu.data.writers import write_blender
    from gsplat_edu.parts.exposure.photos import at_exposure_of_scene

    photo, output = darker_render(1.6)
    camera = procedural.ring_camera(0, 4, 40, 30)
    view = View(camera, photo.image, alpha=photo.alpha, name="a")
    write_blender(tmp_path, [view] * 2, [view])
    dataset = load_dataset(tmp_path, DataSettings(background=None))
    nothing = from_points(dataset.points, dataset.colors, recipe(1))
    found = at_exposure_of_scene(dataset, nothing, lambda *_: output, GREY).train[0].read()
    assert np.array_equal(found.alpha, photo.alpha)
    np.testing.assert_allclose(found.over(GREY) / 255.0, output.image.numpy(), atol=2.5 / 255)

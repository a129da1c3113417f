"""`outside_masks`: where masks of an object exclude pixels, the scene may show anything, or has to be empty."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.parts.empty_outside.term import EmptyOutside
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.views import View
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.feed import Target, ViewFeed
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.objective import Rendered
from masked_object import masked_object


def trainer(views, points, colors, outside, iterations=200):
    config = recipe(
        iterations,
        strategy="fast",
        max_gaussians=600,
        sh_degree=0,
        outside_masks=outside,
        fast_start_factor=1.0,
    )
    start = from_points(points, colors, config)
    return training(config, Views(views), load_backend("cpu"), Start(start, extent=3.5))


def shown(gaussians, views):
    """Return the mean alpha at least two pixels outside the masks, and the mean PSNR inside them."""
    alphas, scores = [], []
    for view in views:
        output, mask = render(gaussians, view.camera, settings=RenderSettings()), view.read().mask
        near = np.pad(mask, 2)
        near = np.any(np.lib.stride_tricks.sliding_window_view(near, (5, 5)), axis=(2, 3))
        alphas.append(float(output.alpha[~torch.from_numpy(near)].mean()))
        scores.append(psnr(output.image.detach(), torch.from_numpy(view.image), torch.from_numpy(mask)))
    return np.mean(alphas), np.mean(scores)


def test_the_surroundings_of_a_masked_object_stay_empty():
    """In held-out views, fog covers all pixels outside the masks, and parts of the object, unless it is forbidden."""
    views, points, colors = masked_object(32, 16, splats=120)
    train, test = [v for i, v in enumerate(views) if i % 4], views[::4]
    found = {}
    for outside in ("ignore", "empty"):
        run = trainer(train, points, colors, outside)
        run.run()
        with torch.no_grad():
            found[outside] = shown(run.gaussians, test)
    assert found["ignore"][0] > 0.5
    assert found["empty"][0] < 0.05
    assert found["empty"][1] >= found["ignore"][1]


def rendered(gaussians, view, target, backend):
    output = render(gaussians, view.camera, backend=backend)
    draw = replace(ViewFeed([view], "shuffled", 0).next(), photo=None)
    return Rendered(gaussians, draw, output, output.image, target, 0)


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_value_and_gradient_are_those_of_the_formula(backend):
    """In float64, they equal autograd of weight sum_outside(1 - T) / (H W) on the dense backend, and pass gradcheck.
    With 45 Gaussians of opacity 0.1, T > 0.008, so no tile stops early and both backends sum the same terms. The sums
    round by 400 pixels times 1e-16; the bound of 1e-9 also covers the order of the factors of T.
    """
    (view, *_), points, colors = masked_object(24, 1, splats=30)
    config = recipe(10, sh_degree=0)
    gaussians = Gaussians(**{n: t.double() for n, t in from_points(points, colors, config).tensors().items()})
    outside = torch.from_numpy(~view.read().mask)
    target = Target(torch.from_numpy(view.image), torch.from_numpy(view.read().mask), None, outside)
    one, other = gaussians.trainable(), gaussians.trainable()
    value = EmptyOutside(0.7)(rendered(one, view, target, backend))
    value.backward()
    transmittance = render(other, view.camera, backend="torch").transmittance
    expected = 0.7 * ((1 - transmittance) * outside).sum() / outside.numel()
    expected.backward()
    torch.testing.assert_close(value, expected, rtol=1e-9, atol=1e-12)
    for name in ("means", "quats", "log_scales", "logit_opacities"):
        torch.testing.assert_close(getattr(one, name).grad, getattr(other, name).grad, rtol=1e-7, atol=1e-11)
    assert one.means.grad.abs().max() > 0

    def term(transmittance):
        given = rendered(gaussians, view, target, "cpu")
        return EmptyOutside(0.7)(replace(given, output=replace(given.output, transmittance=transmittance)))

    start = torch.rand(outside.shape, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(term, (start,))


def test_without_masks_the_bits_are_those_of_ignore():
    views, points, colors = procedural_capture(24, 4, splats=60)
    runs = [trainer(views, points, colors, outside, 30) for outside in ("ignore", "empty")]
    for run in runs:
        run.run()
    for one, other in zip(*(run.gaussians.tensors().values() for run in runs), strict=True):
        assert torch.equal(one, other)


def test_a_resumed_run_has_the_same_bits(tmp_path):
    capture = masked_object(24, 6, splats=60)
    whole, half, rest = (trainer(*capture, "empty", 40) for _ in range(3))
    whole.run()
    half.run(lambda: half.iteration == 23)
    load_checkpoint(save_checkpoint(tmp_path, half, 0.0), rest)
    rest.run()
    for one, other in zip(whole.gaussians.tensors().values(), rest.gaussians.tensors().values(), strict=True):
        assert torch.equal(one, other)


def target_of(view, factor=1.0):
    feed = ViewFeed([view], "shuffled", 0, outside=True)
    feed.use_factor(factor)
    return feed.target(feed.next(), (0.0, 0.0, 0.0))


def test_only_excluded_pixels_that_the_lens_saw_are_outside():
    """Pixels that are partly excluded after downscaling, their neighbours, and pixels outside the lens's view are not
    outside."""
    (view, *_), *_ = masked_object(128, 1, splats=30)
    mask = np.zeros((96, 128), bool)
    mask[9:60, 21:] = True
    view = View(view.camera, view.image, mask=mask)
    expected = np.ones((96, 128), bool)
    expected[8:61, 20:] = False
    np.testing.assert_array_equal(target_of(view).outside, expected)
    half = np.ones((48, 64), bool)
    half[3:31, 9:] = False  # pixels 4 and 10 are partly excluded, and their neighbours do not count either
    np.testing.assert_array_equal(target_of(view, 2.0).outside, half)
    lost = np.zeros_like(mask)
    lost[:2] = True  # not excluded by the mask, and not seen by the lens
    photo = Photo(view.image, None, mask & ~lost, ~mask & ~lost)
    stored = View.stored(view.camera, lambda: photo)
    assert not target_of(stored).outside[:3].any() and target_of(stored).outside[4:7].all()
    opaque = View(view.camera, view.image)
    assert target_of(opaque).outside is None


def test_pixels_that_only_undistortion_excludes_may_show_anything():
    (view, *_), *_ = masked_object(24, 1, splats=30)
    mask = np.ones((18, 24), bool)
    mask[:6] = False
    for lens_only in (True, False):
        photo = Photo(view.image, None, mask, lens_only=lens_only)
        stored = View.stored(view.camera, lambda photo=photo: photo)
        assert (target_of(stored).outside is None) == lens_only
        assert (stored.scaled(2.0).read().excluded is None) == lens_only

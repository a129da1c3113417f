"""The fast recipe: children that resemble their parent, a planned number, growing photos, falling rates."""

import functools
import itertools

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians, cov3d_t
from gsplat_edu.scene.photo import Photo
from gsplat_edu.scene.rig import orbit_camera
from gsplat_edu.scene.views import View
from gsplat_edu.train.checkpoint import load_checkpoint, save_checkpoint
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.config import STRATEGIES, recipe
from gsplat_edu.train.density.fast import PlannedDensity
from gsplat_edu.train.density.surgery import long_axis_children
from gsplat_edu.train.events import DensifyEvent, StepEvent
from gsplat_edu.train.feed import REDUCED_ROOM, SMALLEST_SIDE, ViewFeed
from gsplat_edu.train.initialize import from_points, make_strategy, random_ball
from gsplat_edu.train.optimizer import Adam
from gsplat_edu.train.schedule import gaussian_groups, photo_factor

RENDER = functools.partial(render, backend="cpu")
PARAMETERS = ("quats", "log_scales", "sh0", "sh_rest", "logit_opacities")


@pytest.fixture
def set_threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def config(iterations=3_000, **changes):
    return recipe(iterations, strategy="fast", **{"max_gaussians": 100, **changes})


def stretched(count=50, dtype=torch.float64):
    """Make Gaussians of different scales, axes and opacities."""
    generator = torch.Generator().manual_seed(1)
    ball = random_ball(count, generator, dtype)
    changed = {
        "quats": torch.randn(count, 4, generator=generator, dtype=dtype),
        "log_scales": ball.log_scales + torch.randn(count, 3, generator=generator, dtype=dtype),
        "logit_opacities": 3 * torch.randn(count, generator=generator, dtype=dtype),
    }
    return Gaussians(**(ball.tensors() | changed))


# Children


def test_children_have_the_mean_and_the_covariance_of_their_parent():
    """A mixture of two equal parts at m + d and m - d has the covariance S' + d d'."""
    parents = stretched()
    up, down = long_axis_children(parents)
    offset = (up.means - down.means) / 2
    torch.testing.assert_close((up.means + down.means) / 2, parents.means, atol=1e-15, rtol=0)
    mixed = cov3d_t(up.log_scales, up.quats) + offset[:, :, None] * offset[:, None, :]
    torch.testing.assert_close(mixed, cov3d_t(parents.log_scales, parents.quats), atol=1e-15, rtol=1e-12)
    shrunk = (up.log_scales - parents.log_scales) < 0
    assert torch.equal(shrunk, torch.nn.functional.one_hot(parents.log_scales.argmax(1), 3).bool())


@pytest.mark.parametrize("logit", [-40.0, -5.0, 0.0, 5.0, 30.0])
def test_children_have_the_opacity_of_the_formula(logit):
    parents = stretched(1).map(torch.clone)
    parents.logit_opacities.fill_(logit)
    (child, _) = long_axis_children(parents)
    o, rest = 1 / (1 + np.exp(-logit)), 1 / (1 + np.exp(logit))
    expected = np.sqrt(0.5) * o if logit < -30 else 1 - rest ** np.sqrt(0.5)
    # exp and log round once each; near 1, the rounding relative to 1 - o' matters
    assert float(torch.sigmoid(child.logit_opacities)) == pytest.approx(expected, rel=1e-12)
    if logit > 0:
        assert float(torch.sigmoid(-child.logit_opacities)) == pytest.approx(rest ** np.sqrt(0.5), rel=1e-12)


def test_a_split_changes_the_image_little():
    """At o = 0.18, two children have 2 o' / (sqrt(2) o) = 1.03 times the light of their parent, less where they
    overlap. The largest change is at the centre, one sigma' from both, where alpha is 1 - (1 - o' e^(-1/2))^2 = 0.85
    o.
    """
    camera = orbit_camera(0.3, 0.2, 64, 80.0, 3.0)
    parent = random_ball(1, torch.Generator().manual_seed(0), torch.float64).map(torch.clone)
    parent.log_scales[0] = torch.log(torch.tensor([0.3, 0.12, 0.1]))
    parent.logit_opacities.fill_(-1.5)
    before, after = (
        1 - RENDER(g, camera).transmittance
        for g in (parent, Gaussians.concatenated(long_axis_children(parent)))
    )
    assert 1.0 < float(after.sum() / before.sum()) < 1.03
    assert 0.14 < float((before - after).abs().max() / before.max()) < 0.16


# The plan


def observed(control, norms):
    """Make the strategy observe every Gaussian with these gradient norms."""
    control.norm_sums += torch.as_tensor(norms).to(control.norm_sums)
    control.times_visible += 1


def test_the_number_follows_the_plan_and_pruned_gaussians_are_replaced():
    gaussians = random_ball(40, torch.Generator().manual_seed(0)).map(lambda t: t + 0).trainable()
    run = config(3_000, max_gaussians=100, densify_start=100, fast_stop=600)
    control = PlannedDensity(run, gaussians)
    optimizer = Adam(gaussians.tensors(), gaussian_groups(run, 1.0))
    counts = []
    for iteration in range(1, 1_001):
        observed(control, np.ones(len(gaussians)))
        if iteration == 350:
            with torch.no_grad():
                gaussians.logit_opacities[:5] = -9.0
        gaussians, events = control.update(iteration, gaussians, optimizer)
        assert all(event.num_gaussians == len(gaussians) for event in events)
        counts += [len(gaussians)] * bool(events)
    assert counts == [52, 64, 76, 88, 100, 100, 100, 100, 100]
    assert all(len(m) == 100 for m in optimizer.first.values())


def test_after_the_plan_only_invisible_gaussians_are_removed_and_none_is_added():
    """A Gaussian of opacity 0.01 is faint but drawn, and below 1/255 it is not drawn."""
    gaussians = random_ball(40, torch.Generator().manual_seed(0)).trainable()
    run = config(max_gaussians=100, densify_start=100, fast_stop=200)
    control = PlannedDensity(run, gaussians)
    optimizer = Adam(gaussians.tensors(), gaussian_groups(run, 1.0))
    with torch.no_grad():
        gaussians.logit_opacities[:3] = torch.tensor([-9.0, -5.6, -4.6])
        gaussians.means[3] = torch.nan
    observed(control, np.ones(40))
    gaussians, (event,) = control.update(300, gaussians, optimizer)
    assert (event.num_pruned, event.num_split_children, len(gaussians)) == (3, 0, 37)
    assert float(gaussians.opacities.detach().min()) == pytest.approx(1 / (1 + np.exp(4.6)))


def test_gaussians_of_the_highest_score_are_split():
    gaussians = random_ball(5, torch.Generator().manual_seed(0))
    control = PlannedDensity(config(), gaussians)
    observed(control, [0.0, 1.0, 3.0, 1.0, 2.0])
    everyone = torch.ones(5, dtype=torch.bool)
    assert control.highest(everyone, 3).tolist() == [False, True, True, False, True], (
        "the first of equal scores are split"
    )
    assert int(control.highest(everyone, 9).sum()) == 4, "a Gaussian without a score is never split"
    assert not control.highest(~everyone, 2).any()
    assert not control.highest(everyone, -2).any()


def test_a_poisoned_score_is_never_split():
    gaussians = random_ball(4, torch.Generator().manual_seed(0))
    control = PlannedDensity(config(), gaussians)
    observed(control, [np.nan, np.inf, 1.0, 0.0])
    assert control.highest(torch.ones(4, dtype=torch.bool), 1).tolist() == [False, True, False, False]
    assert control.highest(torch.ones(4, dtype=torch.bool), 4).tolist() == [False, True, True, False]


def test_the_strategy_needs_a_cap():
    with pytest.raises(ArgumentError, match="max_gaussians: the strategy fast"):
        make_strategy(config(max_gaussians=None), 1.0, random_ball(3, torch.Generator()))


# Schedules


def test_photos_grow_by_equal_steps_to_their_full_size():
    run = config(3_000)
    factors = [photo_factor(run, i) for i in range(3_000)]
    steps = [(value, len(list(group))) for value, group in itertools.groupby(factors)]
    expected = [(4.0, 450), (8**0.5, 450), (2.0, 450), (2**0.5, 450), (1.0, 1_200)]
    assert [n for _, n in steps] == [n for _, n in expected]
    np.testing.assert_allclose([f for f, _ in steps], [f for f, _ in expected], rtol=1e-15)


@pytest.mark.parametrize("start", [1.0, 1.2, 2.0, 3.0, 16.0])
@pytest.mark.parametrize("full_size", [0, 1, 3, 50])
def test_any_start_factor_falls_to_one(start, full_size):
    run = config(50, fast_start_factor=start, fast_full_size=full_size)
    factors = [photo_factor(run, i) for i in range(50)]
    assert factors == sorted(factors, reverse=True) and factors[full_size:] == [1.0] * (50 - full_size)
    assert factors[0] == (start if full_size else 1.0) and min(factors) >= 1.0


@pytest.mark.parametrize("strategy", [name for name in STRATEGIES if name != "fast"])
def test_other_strategies_keep_photos_and_rates(strategy):
    run = recipe(100, strategy=strategy, max_gaussians=10)
    assert {photo_factor(run, i) for i in range(100)} == {1.0}
    groups = gaussian_groups(run, 1.0)
    assert all(groups[name].rate_at(99) == groups[name].rate_at(0) for name in PARAMETERS)


def test_rates_fall_tenfold_over_the_last_part_of_the_run():
    run = config(1_000)
    groups = gaussian_groups(run, 1.0)
    for name in PARAMETERS:
        first = groups[name].rate_at(0)
        assert groups[name].rate_at(700) == first
        assert groups[name].rate_at(850) == pytest.approx(first * 0.1**0.5, rel=1e-12)
        assert (
            groups[name].rate_at(1_000)
            == groups[name].rate_at(5_000)
            == pytest.approx(0.1 * first, rel=1e-12)
        )


# Views of reduced size


def checkerboard(W, H, alpha=False, mask=False):
    rng = np.random.default_rng(0)
    camera = Camera.looking_at((0, 0, -3), (0, 0, 0), 1.1 * W, 1.0 * W, H, W)
    image = rng.integers(0, 256, (H, W, 3), dtype=np.uint8)
    opaque = rng.integers(0, 256, (H, W), dtype=np.uint8) if alpha else None
    counts = rng.random((H, W)) < 0.99 if mask else None
    return View(camera, image, alpha=opaque, mask=counts, name="x")


def test_a_reduced_view_shows_the_same_rays_and_the_mean_colour():
    view = checkerboard(120, 90)
    small = view.scaled(2.8)
    camera, full = small.camera, view.camera
    assert (camera.W, camera.H) == (43, 32) and small.read().image.shape == (32, 43, 3)
    edges = (
        [(-0.5 - c.cx) / c.fx for c in (camera, full)],
        [(c.W - 0.5 - c.cx) / c.fx for c in (camera, full)],
    )
    for a, b in edges:
        assert a == pytest.approx(b, abs=1e-15)
    means = small.read().image.mean((0, 1)), view.read().image.mean((0, 1))
    np.testing.assert_allclose(*means, atol=0.5)  # bytes are rounded by at most a half
    assert view.scaled(1.0) is view


def test_reduced_colour_is_weighted_by_alpha_and_masks_shrink():
    image = np.zeros((4, 4, 3), np.uint8)
    image[:, ::2] = 200
    alpha = np.zeros((4, 4), np.uint8)
    alpha[:, ::2] = 255
    mask = np.ones((4, 4), np.bool_)
    mask[0, 0] = False
    small = Photo(image, alpha, mask).scaled(2, 2)
    assert (small.image == 200).all() and (small.alpha == 128).all()
    assert small.mask.tolist() == [[False, True], [True, True]]
    floats = Photo(image / 255.0, alpha).scaled(2, 2)
    assert np.array_equal(floats.image, small.image) and np.array_equal(floats.alpha, small.alpha)


def test_the_order_of_the_views_does_not_depend_on_their_size():
    views = [checkerboard(80, 64) for _ in range(5)]
    plain, growing = (ViewFeed(views, "shuffled", 3) for _ in range(2))
    for step in range(20):
        growing.use_factor(2.0 if step < 11 else 1.0)
        a, b = plain.next(), growing.next()
        assert a.index == b.index and plain.state() == growing.state()
        factor = 2 if step < 11 else 1
        assert b.view.camera.W == 80 // factor == growing.target(b, (0, 0, 0)).image.shape[1]


@pytest.mark.parametrize("kinds", [{}, {"alpha": True}, {"mask": True}, {"alpha": True, "mask": True}])
@pytest.mark.parametrize("background", [(1.0, 0.0, 0.5), None])
def test_reduced_photos_are_kept_and_equal_those_that_are_not(kinds, background, monkeypatch):
    view = checkerboard(100, 80, **kinds)
    reads = []
    stored = View.stored(view.camera, lambda: reads.append(1) or view.read(), "x")
    behind = background or (0.2, 0.4, 0.6)

    def targets():
        feed = ViewFeed([stored], "shuffled", 0, background)
        feed.use_factor(2.0)
        found = [feed.target(feed.next(), behind) for _ in range(4)]
        feed.close()
        return found

    kept = targets()
    assert len(reads) == 1
    monkeypatch.setattr("gsplat_edu.train.feed.REDUCED_ROOM", 10)
    again = targets()
    assert len(reads) >= 5
    for a, b in zip(kept, again, strict=True):
        assert torch.equal(a.image, b.image) and (a.mask is None or torch.equal(a.mask, b.mask))
    assert REDUCED_ROOM > 10


def test_photos_are_not_reduced_below_the_size_that_ssim_needs():
    feed = ViewFeed([checkerboard(40, 64), checkerboard(300, 200)], "shuffled", 0)
    feed.use_factor(4.0)
    assert min(min(v.camera.W, v.camera.H) for v in feed.views) == SMALLEST_SIDE
    feed = ViewFeed([checkerboard(20, 64)], "shuffled", 0)
    feed.use_factor(4.0)
    assert feed.views[0].camera.W == 20


# Whole trainings


@functools.cache
def capture():
    return procedural_capture(96, 6, splats=120)


def trainer(run, views=None, points=None):
    known, where, colors = capture()
    where = where if points is None else points
    colors = colors if points is None else np.full_like(points, 0.5)
    start = from_points(where, colors, run)
    return training(run, Views(views or known), load_backend("cpu"), Start(start, extent=2.0))


SHORT = {"densify_every": 10, "max_gaussians": 200}


def bits(done):
    return {name: tensor.detach().numpy().tobytes() for name, tensor in done.gaussians.tensors().items()}


def test_the_weight_on_opacity_ends_with_the_plan():
    events = []
    run = trainer(config(10, fast_stop=6))
    run.run(callbacks=[lambda _, event: events.append(event)])
    values = [float(event.terms["opacity"]) for event in events if isinstance(event, StepEvent)]
    assert min(values[:6]) > 0 and values[6:] == [0.0] * 4


def test_any_number_of_threads_gives_the_same_bits(set_threads):
    found = []
    for threads in (1, 2, 5):
        set_threads(threads)
        run = trainer(config(60, **SHORT))
        losses = run.run().losses
        found.append((losses, bits(run)))
    assert found[0] == found[1] == found[2]
    assert len(run.gaussians) > 120


@pytest.mark.parametrize("stop", [1, 17, 18, 27, 36, 37, 50])
def test_a_resumed_training_has_the_same_bits(tmp_path, stop):
    """Runs are interrupted in every phase: at each change of the photo size, while growing, and while rates fall."""
    whole = trainer(config(60, **SHORT))
    losses = whole.run().losses
    first = trainer(config(60, **SHORT))
    first.run(stop=lambda: first.iteration == stop)
    path = save_checkpoint(tmp_path, first, 0.0)
    second = trainer(config(60, **SHORT))
    load_checkpoint(path, second)
    assert second.run().losses == losses[stop:] and bits(second) == bits(whole)


def views_of(size):
    """Return the capture's views with photos of `size` px; photos below the smallest side keep their size."""
    known, _, _ = capture()
    return [view.scaled(96 / size) for view in known]


@pytest.mark.parametrize(
    ("iterations", "size", "cap", "points"),
    [
        (50, 96, 1_000, None),
        (1, 96, 1_000, None),
        (40, 64, 1_000, None),
        (40, 20, 150, None),
        (40, 96, 30, None),
        (40, 96, 1_000, np.zeros((1, 3))),
        (40, 96, 1, np.zeros((2, 3))),
    ],
)
def test_extreme_runs_train_to_their_end(iterations, size, cap, points):
    run = trainer(config(iterations, densify_every=5, max_gaussians=cap), views_of(size), points)
    result = run.run()
    assert len(result.losses) == iterations and np.isfinite(result.losses).all()
    assert 1 <= len(run.gaussians) <= cap


def test_the_recipe_learns_the_scene():
    """The loss at full size falls to a third of that at the start, and the number reaches the plan."""
    run = trainer(config(150, densify_every=10, max_gaussians=300))
    events = []
    full = trainer(config(1, fast_full_size=0)).run().losses[0]
    losses = run.run(callbacks=[lambda _, event: events.append(event)]).losses
    assert np.mean(losses[-6:]) < full / 3
    changes = [event for event in events if isinstance(event, DensifyEvent)]
    assert max(event.num_gaussians for event in changes) == 300


@pytest.mark.parametrize(("iterations", "every"), [(1, 1), (50, 2), (1_000, 50), (2_000, 100), (10_000, 100)])
def test_short_runs_densify_often_enough(iterations, every):
    assert recipe(iterations, strategy="fast").densify_every == every
    assert recipe(iterations, strategy="fast", densify_every=70).densify_every == 70
    assert recipe(iterations, strategy="fast", rescale=False).densify_every == 100
    assert recipe(iterations).densify_every == 100

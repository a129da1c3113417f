"""The recipe: its defaults are those of the papers; rescaling, and the schedule."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu import C0, ArgumentError
from gsplat_edu.data.synthetic import ORBIT_RADIUS
from gsplat_edu.train.config import MILESTONES, TrainConfig, recipe
from gsplat_edu.train.course import EXTENT
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.events import DensifyEvent, ResetEvent
from gsplat_edu.train.initialize import from_points, make_strategy, random_ball
from gsplat_edu.train.optimizer import Adam
from gsplat_edu.train.schedule import means_rate, sh_degree


def test_the_defaults_match_the_papers():
    """The papers are Kerbl et al. 2023 and Kheradmand et al. 2024, with their code."""
    config = TrainConfig()
    expected = {
        "iterations": 30_000,
        "means_rate": 1.6e-4,
        "means_rate_final": 1.6e-6,
        "sh0_rate": 2.5e-3,
        "sh_rest_rate": 2.5e-3 / 20,
        "opacities_rate": 5e-2,
        "scales_rate": 5e-3,
        "quats_rate": 1e-3,
        "adam_eps": 1e-15,
        "ssim_weight": 0.2,
        "sh_every": 1_000,
        "start_opacity": 0.1,
        "densify_start": 500,
        "densify_stop": 15_000,
        "densify_every": 100,
        "grad_threshold": 2e-4,
        "percent_dense": 0.01,
        "split_shrink": 1.6,
        "min_opacity": 0.005,
        "prune_scale": 0.1,
        "reset_every": 3_000,
        "reset_opacity": 0.01,
        "view_order": "shuffled",
        "mcmc_stop": 25_000,
        "mcmc_growth": 1.05,
        "mcmc_noise": 5e5,
        "mcmc_opacity_weight": 0.01,
        "mcmc_scale_weight": 0.01,
    }
    flat = config.flat()
    assert {name: flat[name] for name in expected} == expected


def test_milestones_are_rescaled_and_intervals_are_not():
    short = recipe(7_000)
    factor = 7_000 / 30_000
    for name in MILESTONES:
        assert short.flat()[name] == round(TrainConfig().flat()[name] * factor), name
    assert (short.densify_start, short.adc.densify_stop, short.adc.reset_every) == (117, 3_500, 700)
    assert short.densify_every == 100 and short.means_rate_iterations == 7_000
    assert recipe() == TrainConfig()


def test_rescaling_can_be_disabled_and_keeps_explicit_values():
    plain = recipe(7_000, rescale=False)
    assert plain == TrainConfig(iterations=7_000)
    assert recipe(7_000, densify_stop=6_000).adc.densify_stop == 6_000


@pytest.mark.parametrize("name", ["iterations", "max_gaussians", "seed", "densify_stop", "mcmc_stop"])
def test_no_whole_number_exceeds_64_bits(name):
    assert TrainConfig().changed(**{name: 2**63 - 1}).flat()[name] == 2**63 - 1
    with pytest.raises(ArgumentError, match=f"{name}: is 9223372036854775808"):
        TrainConfig().changed(**{name: 2**63})


def test_short_runs_do_not_reset():
    assert recipe(2_999).adc.reset_every == 0 and recipe(2_999, rescale=False).adc.reset_every == 0
    assert recipe(3_000).adc.reset_every == 300
    assert recipe(2_999, reset_every=50).adc.reset_every == 50


def test_the_rate_of_the_means_falls_log_linearly():
    config = TrainConfig()
    assert means_rate(config, 2.0, 0) == pytest.approx(3.2e-4)
    assert means_rate(config, 2.0, 15_000) == pytest.approx(3.2e-5), (
        "half way through a fall by 100, the rate has fallen by 10"
    )
    assert means_rate(config, 2.0, 30_000) == pytest.approx(3.2e-6)
    assert means_rate(config, 2.0, 40_000) == pytest.approx(3.2e-6)


def test_sh_degrees_are_enabled_one_at_a_time():
    config = TrainConfig()
    assert [sh_degree(config, i) for i in (0, 999, 1_000, 2_999, 3_000, 29_999)] == [0, 0, 1, 2, 3, 3]
    assert sh_degree(TrainConfig(sh_every=0), 0) == 3
    assert sh_degree(TrainConfig(sh_degree=1), 5_000) == 1


def test_the_course_orbits_at_its_extent():
    assert EXTENT == ORBIT_RADIUS


def scene(count=50, scale=0.05):
    return random_ball(count, torch.Generator().manual_seed(0)).map(torch.clone).trainable()


def due(config, iterations):
    """Return the events after each iteration, for a scene without gradients."""
    gaussians = scene()
    control, optimizer = (
        make_strategy(config, 1.0, gaussians),
        Adam(gaussians.tensors(), config.learning_rates),
    )
    found = []
    for iteration in iterations:
        gaussians, events = control.update(iteration, gaussians, optimizer)
        found += [(type(event), event.iteration) for event in events]
    return found


def test_the_schedule_of_densifications_and_resets():
    config = recipe(prune_scale=0.0)
    found = due(config, [0, 100, 500, 501, 600, 650, 700, 3_000, 6_000, 14_900, 15_000, 18_000])
    densified = [i for kind, i in found if kind is DensifyEvent]
    assert densified == [600, 700, 3_000, 6_000, 14_900]
    assert [i for kind, i in found if kind is ResetEvent] == [3_000, 6_000]


def test_a_white_background_adds_an_early_reset():
    white = recipe(background=(1.0, 1.0, 1.0), prune_scale=0.0)
    found = due(white, [500, 501, 502, 3_000])
    assert [i for kind, i in found if kind is ResetEvent] == [500, 3_000]
    assert not [
        i for kind, i in due(recipe(1_000, background=(1.0, 1.0, 1.0)), range(600)) if kind is ResetEvent
    ]


def test_a_reset_lowers_opacities_and_clears_only_their_moments():
    config, gaussians = recipe(prune_scale=0.0), scene()
    optimizer = Adam(gaussians.tensors(), config.learning_rates)
    for moments in (optimizer.first, optimizer.second):
        for tensor in moments.values():
            tensor.fill_(1.0)
    with torch.no_grad():
        gaussians.logit_opacities[0] = -5.0  # 0.0067, below the ceiling of a reset but not pruned
    control = AdaptiveDensityControl(config, 1.0, torch.Generator(), gaussians)
    changed, _ = control.update(3_000, gaussians, optimizer)
    logits = changed.logit_opacities.detach().sort().values
    torch.testing.assert_close(torch.sigmoid(logits[1:]), torch.full((49,), 0.01))
    assert logits[0] == -5.0
    for moments in (optimizer.first, optimizer.second):
        assert (moments["logit_opacities"] == 0).all()
        assert all((tensor == 1).all() for name, tensor in moments.items() if name != "logit_opacities")


def test_large_gaussians_are_pruned_once_opacities_have_been_reset():
    config = TrainConfig()
    for iteration, left in ((3_000, 50), (3_100, 49)):
        gaussians = scene()
        with torch.no_grad():
            gaussians.log_scales[7] = math.log(0.11 * 2.0)
        control = AdaptiveDensityControl(config, 2.0, torch.Generator(), gaussians)
        changed, events = control.update(
            iteration, gaussians, Adam(gaussians.tensors(), config.learning_rates)
        )
        assert len(changed) == left and events[0].num_pruned == 50 - left


@pytest.mark.parametrize("cap", [50, 53, 60])
def test_near_the_cap_the_largest_gradients_densify_first(cap):
    """20 of 50 Gaussians exceed the threshold, half of them to be cloned and half to be split. Each adds one."""
    config, gaussians = recipe(max_gaussians=cap, percent_dense=0.01), scene()
    with torch.no_grad():
        gaussians.log_scales[:10] = math.log(0.001)
    control = AdaptiveDensityControl(config, 1.0, torch.Generator().manual_seed(0), gaussians)
    control.times_visible[:] = 1
    control.norm_sums[:20] = 1.0 + torch.arange(20.0)
    changed, (event,) = control.update(600, gaussians, Adam(gaussians.tensors(), config.learning_rates))
    assert len(changed) == cap
    # Gaussians 19, 18 ... have the largest gradients and are large, so they are split.
    assert event.num_split_children == 2 * min(cap - 50, 10) and event.num_cloned == 0
    assert event.num_pruned == 0


def test_start_from_points():
    """The distances of four points in a row to their three neighbours are obvious."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0]])
    colors = np.array([[0.5, 0.5, 0.5], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    gaussians = from_points(points, colors, TrainConfig())
    expected = np.sqrt([(1 + 9 + 49) / 3, (1 + 4 + 36) / 3, (4 + 9 + 16) / 3, (16 + 36 + 49) / 3])
    np.testing.assert_allclose(gaussians.scales.numpy(), np.repeat(expected[:, None], 3, 1), rtol=1e-6)
    np.testing.assert_allclose(gaussians.sh0[:, 0].numpy() * C0 + 0.5, colors, atol=1e-6)
    np.testing.assert_allclose(gaussians.opacities.numpy(), 0.1, rtol=1e-6)
    assert gaussians.sh_degree == 3 and (gaussians.sh_rest == 0).all()
    shrunk = from_points(points, colors, TrainConfig(strategy="mcmc", max_gaussians=9))
    np.testing.assert_allclose(shrunk.scales.numpy(), 0.1 * gaussians.scales.numpy(), rtol=1e-6)
    np.testing.assert_allclose(shrunk.opacities.numpy(), 0.5, rtol=1e-6)


def test_a_point_cloud_larger_than_the_cap_is_subsampled():
    points = np.random.default_rng(0).normal(size=(200, 3))
    config = TrainConfig(max_gaussians=80, seed=4)
    some = from_points(points, np.zeros((200, 3)), config)
    assert len(some) == 80 and torch.equal(some.means, from_points(points, np.zeros((200, 3)), config).means)
    assert not torch.equal(some.means, torch.tensor(points[:80], dtype=torch.float32)), (
        "not simply the first 80"
    )


def test_degenerate_point_clouds():
    one = from_points([[1.0, 2, 3]], [[0, 0, 0]], TrainConfig())
    assert len(one) == 1 and torch.isfinite(one.log_scales).all()
    same = from_points(np.ones((5, 3)), np.ones((5, 3)), TrainConfig())
    assert torch.isfinite(same.log_scales).all(), "coinciding points have a minimum scale"
    with pytest.raises(ArgumentError, match="^points: is empty"):
        from_points(np.zeros((0, 3)), np.zeros((0, 3)), TrainConfig())

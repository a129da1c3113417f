"""Cloning, splitting, pruning and the cap, on four Gaussians with hand-made gradients."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from gsplat_edu import Camera
from gsplat_edu.render.api import render
from gsplat_edu.render.torch.render import eval_sh_t, render_t
from gsplat_edu.scene.gaussians import Gaussians, cov3d_t
from gsplat_edu.train.config import recipe
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.density.surgery import replace, sorted_in_space, split_children
from gsplat_edu.train.optimizer import Adam

SMALL, LARGE = math.log(0.02), math.log(0.2)  # 1 % of the extent 3.0 is 0.03
CONFIG = recipe(densify_start=99, densify_stop=600, reset_every=0, over_cap="cut")
EXTENT = 3.0


def four(dtype=torch.float64) -> Gaussians:
    """Return four Gaussians: a small one, two large ones, and a small one so faint that it is pruned."""
    n = 4
    return Gaussians(
        means=torch.arange(n * 3, dtype=dtype).reshape(n, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).repeat(n, 1),
        log_scales=torch.tensor([SMALL, LARGE, LARGE, SMALL], dtype=dtype)[:, None].repeat(1, 3),
        sh0=torch.arange(n, dtype=dtype)[:, None, None].repeat(1, 1, 3),
        sh_rest=torch.zeros(n, 0, 3, dtype=dtype),
        logit_opacities=torch.tensor([0.0, 0.0, 0.0, -6.0], dtype=dtype),
    ).trainable()


def controlled(hot, config=CONFIG):
    """Return density control after two renders; `hot` are the gradients in units of the threshold."""
    gaussians = four()
    optimizer = Adam(gaussians.tensors(), {"means": 1e-3})
    optimizer.first["means"] = torch.arange(12.0, dtype=torch.float64).reshape(4, 3) + 1
    control = AdaptiveDensityControl(config, EXTENT, torch.Generator().manual_seed(0), gaussians)
    control.norm_sums = torch.tensor(hot, dtype=torch.float64) * 2 * 1.01 * config.adc.grad_threshold
    control.times_visible = torch.full((4,), 2.0, dtype=torch.float64)
    return control, gaussians, optimizer


@pytest.mark.parametrize(
    ("over_cap", "rows"),
    [
        ("cut", {"survivors": [0, 1], "clone": [2], "children": [3, 4]}),
        ("strongest", {"survivors": [0, 4], "clone": [1], "children": [2, 3]}),  # sorted in space
    ],
)
def test_small_gaussians_are_cloned_large_ones_split_and_faint_ones_pruned(over_cap, rows):
    config = dataclasses.replace(CONFIG, adc=dataclasses.replace(CONFIG.adc, over_cap=over_cap))
    control, gaussians, optimizer = controlled([1, 1, 0, 1], config)
    changed, (event,) = control.update(100, gaussians, optimizer)
    assert dataclasses.astuple(event) == (100, 1, 2, 1, 5)
    survivors, clone, children = rows.values()
    assert changed.sh0[[*survivors, *clone, *children], 0, 0].tolist() == [0, 2, 0, 1, 1]
    torch.testing.assert_close(changed.means[[*survivors, *clone]], gaussians.means[[0, 2, 0]])
    expected = torch.tensor([SMALL, LARGE, SMALL, LARGE - math.log(1.6), LARGE - math.log(1.6)])
    torch.testing.assert_close(changed.log_scales[[*survivors, *clone, *children], 0], expected.double())
    offsets = changed.means[children] - gaussians.means[1]
    assert (offsets != 0).all() and (offsets.abs() < 5 * 0.2).all() and (offsets[0] != offsets[1]).all()
    moments = torch.tensor([[1.0, 2, 3], [7, 8, 9]]).double()
    torch.testing.assert_close(optimizer.first["means"][survivors], moments)
    assert (optimizer.first["means"][[*clone, *children]] == 0).all()
    assert all(t.requires_grad and t.is_leaf for t in changed.tensors().values())
    assert len(control.norm_sums) == 5 and (control.norm_sums == 0).all(), "the sums of gradients are reset"


def test_the_threshold_applies_to_the_mean_over_views_that_see_it():
    control, gaussians, optimizer = controlled(hot=[1, 0, 0, 0])
    control.times_visible[0] = 3
    _, (event,) = control.update(100, gaussians, optimizer)
    assert event.num_cloned == 0
    control, gaussians, optimizer = controlled(hot=[0.5, 0, 0, 0])
    control.times_visible[0] = 1
    _, (event,) = control.update(100, gaussians, optimizer)
    assert event.num_cloned == 1, "a Gaussian seen by one view has that view's gradient as its mean"


@pytest.mark.parametrize(
    ("iteration", "due"), [(0, False), (99, False), (100, True), (150, False), (500, True), (600, False)]
)
def test_densification_happens_only_within_its_window(iteration, due):
    control, gaussians, optimizer = controlled(hot=[0, 0, 0, 0])
    assert bool(control.update(iteration, gaussians, optimizer)[1]) == due


@pytest.mark.parametrize("cap", [1, 2, 3, 4])
def test_the_cap_drops_the_last_gaussians(cap):
    control, gaussians, optimizer = controlled([1, 1, 0, 1], dataclasses.replace(CONFIG, max_gaussians=cap))
    changed, (event,) = control.update(100, gaussians, optimizer)
    assert event.num_gaussians == len(changed) == cap
    assert changed.sh0[:, 0, 0].tolist() == [0, 2, 0, 1, 1][:cap]
    assert len(optimizer.first["means"]) == cap


def test_all_gaussians_may_be_pruned():
    gaussians = four().map(lambda t: t.detach()[3:]).trainable()
    optimizer = Adam(gaussians.tensors(), {"means": 1e-3})
    control = AdaptiveDensityControl(CONFIG, EXTENT, torch.Generator(), gaussians)
    changed, (event,) = control.update(100, gaussians, optimizer)
    assert len(changed) == 0 and event.num_pruned == 1
    assert control.update(200, changed, optimizer)[1][0].num_gaussians == 0


def test_children_are_drawn_from_the_parents_distribution():
    """20,000 children of one parent have the parent's covariance. The relative error of the sample covariance is
    about sqrt(2 / 20,000) = 1 %, of which five are allowed.
    """
    from gsplat_edu import build_cov3d, quat_to_R

    quat, scale = np.array([0.9, 0.3, -0.2, 0.4]), np.array([0.3, 0.1, 0.02])
    one = {
        "means": torch.tensor([[1.0, 2.0, 3.0]]),
        "quats": torch.tensor(quat)[None],
        "log_scales": torch.tensor(np.log(scale))[None],
    }
    many = {name: t.double().repeat(20_000, 1) for name, t in one.items()}
    rest = {
        "sh0": torch.zeros(20_000, 1, 3).double(),
        "sh_rest": torch.zeros(20_000, 0, 3).double(),
        "logit_opacities": torch.zeros(20_000).double(),
    }
    children = split_children(Gaussians(**many, **rest), 1.6, torch.Generator().manual_seed(0))
    cov = np.cov(children.means.numpy().T)
    expected = build_cov3d(scale, quat_to_R(quat))
    assert np.abs(cov - expected).max() < 0.05 * np.abs(expected).max()
    np.testing.assert_allclose(children.scales[0].numpy(), scale / 1.6)


def test_replace_without_change_is_the_identity():
    gaussians = four()
    optimizer = Adam(gaussians.tensors(), {"means": 1e-3})
    same = replace(gaussians, optimizer, torch.ones(4, dtype=torch.bool), [], cap=10)
    for name, tensor in same.tensors().items():
        torch.testing.assert_close(tensor, gaussians.tensors()[name], rtol=0, atol=0)


def scattered(count):
    """Return Gaussians at random places, of which some are NaN and some are equal; their opacities number them."""
    draw = torch.Generator().manual_seed(5)
    gaussians = four(torch.float32).map(lambda t: t.detach()[torch.arange(count) % 4])
    means = torch.randn(count, 3, generator=draw)
    means[::7] = means[:1].clone()
    means[::11, 1], means[::13, 0], means[::17, 2] = math.nan, math.inf, -1e38
    return dataclasses.replace(
        gaussians, means=means, logit_opacities=torch.arange(count).float()
    ).trainable()


def test_parameters_and_moments_of_a_gaussian_move_together():
    """Surviving Gaussians keep their parameters and moments; new ones have zero moments."""
    count = 3000
    gaussians = scattered(count)
    optimizer = Adam(gaussians.tensors(), dict.fromkeys(gaussians.tensors(), 1e-3))
    for moments in (optimizer.first, optimizer.second):
        for name, moment in moments.items():
            moments[name] = torch.rand(moment.shape, generator=torch.Generator().manual_seed(len(name)))
    before = {name: moment.clone() for name, moment in optimizer.second.items()}
    keep = torch.arange(count) % 5 != 0
    newborn = gaussians.map(lambda tensor: tensor.detach()[~keep])
    after = replace(gaussians, optimizer, keep, [newborn])
    origin = after.logit_opacities.detach().long()
    assert sorted(origin.tolist()) == list(range(count)) and origin.tolist() != list(range(count))
    for name, tensor in after.tensors().items():
        torch.testing.assert_close(tensor, gaussians.tensors()[name][origin], rtol=0, atol=0, equal_nan=True)
        expected = torch.where(keep.reshape(-1, *[1] * (tensor.ndim - 1)), before[name], 0.0)[origin]
        torch.testing.assert_close(optimizer.second[name], expected, rtol=0, atol=0)


def test_the_order_is_the_same_on_any_number_of_threads():
    gaussians, threads, found = scattered(50_000), torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            found.append(sorted_in_space(gaussians).logit_opacities)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


@pytest.mark.parametrize("backend", ["cpu", "torch"])
def test_observed_norms_are_ndc_gradients_of_visible_gaussians(backend):
    """The norm is |(gx W/2, gy H/2)|. The image is not square, so the two factors differ."""
    camera = Camera.looking_at((0, 0, -3), (0, 0, 0), 20, 20, 12, 30)
    gaussians = four().map(lambda t: t.detach().clone())
    means = torch.tensor([[0.1, 0.1, 0], [-0.2, 0.1, 0.5], [0, 0, -9.0], [0.3, -0.1, 0]], dtype=torch.float64)
    gaussians = dataclasses.replace(gaussians, means=means).trainable()
    control = AdaptiveDensityControl(CONFIG, EXTENT, torch.Generator(), gaussians)
    for _ in range(2):
        out = render(gaussians, camera, backend=backend)
        (out.image**2).sum().backward()
        control.observe(gaussians, out)
    covs, colors = (
        cov3d_t(gaussians.log_scales, gaussians.quats),
        eval_sh_t(0, gaussians.sh0, gaussians.means),
    )
    dense = render_t(gaussians.means, covs, colors, gaussians.opacities, camera, track_means2d=True)
    (dense.image**2).sum().backward()
    seen, gradient = dense.visible, dense.means2d.grad
    expected = torch.zeros(4, dtype=torch.float64)
    expected[seen] = 2 * torch.sqrt((gradient[:, 0] * 15) ** 2 + (gradient[:, 1] * 6) ** 2)
    torch.testing.assert_close(control.norm_sums, expected)
    # The third is behind the camera. The fourth is too faint to be drawn, so the kernels do not count it.
    assert control.times_visible.tolist() == ([2, 2, 0, 0] if backend == "cpu" else [2, 2, 0, 2])

"""MCMC: relocation preserves the image, the cap is kept, and noise moves faint Gaussians."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.scene.gaussians import cov3d_t
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.mcmc import MCMC, MOST_SHARERS, shared_shape
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.optimizer import Adam

CONFIG = TrainConfig(strategy="mcmc", max_gaussians=100)


def scene(count=60, dtype=torch.float64):
    return random_ball(count, torch.Generator().manual_seed(0), dtype).trainable()


def make(gaussians, config=CONFIG, seed=0):
    return MCMC(config, torch.Generator().manual_seed(seed)), Adam(gaussians.tensors(), config.learning_rates)


@pytest.mark.parametrize("n", [1, 2, 3, 7, MOST_SHARERS])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_copies_have_the_opacity_and_scale_of_the_paper(n, opacity):
    """They equal the double sum of eq. 9, computed term by term with exact binomials."""
    each, factor = shared_shape(torch.tensor([opacity], dtype=torch.float64), torch.tensor([n]))
    assert 1 - (1 - float(each)) ** n == pytest.approx(opacity, rel=1e-12)
    o = float(each)
    total = math.fsum(
        math.comb(i - 1, k) * (-1) ** k * o ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, n + 1)
        for k in range(i)
    )
    # The terms cancel, and reach (1 + o')^n, at most 500, in float64.
    assert float(factor) == pytest.approx(opacity / total, rel=1e-9)


def test_copies_have_nearly_the_integral_of_the_original():
    """Along a line through the centre, n composited copies have nearly the integral of the original splat."""
    x = np.linspace(-6, 6, 4001)
    for n, opacity in ((2, 0.5), (5, 0.9), (20, 0.99)):
        each, factor = (float(t) for t in shared_shape(torch.tensor([opacity]).double(), torch.tensor([n])))
        before = opacity * np.exp(-0.5 * x**2)
        after = 1 - (1 - each * np.exp(-0.5 * (x / factor) ** 2)) ** n
        assert np.trapezoid(after, x) == pytest.approx(np.trapezoid(before, x), rel=1e-6)


def test_dead_gaussians_are_relocated_to_living_ones():
    gaussians = scene()
    control, optimizer = make(gaussians, TrainConfig(strategy="mcmc", max_gaussians=60))
    with torch.no_grad():
        gaussians.logit_opacities[:10] = -8.0
        gaussians.logit_opacities[10:] = 1.0
    for moments in (optimizer.first, optimizer.second):
        for tensor in moments.values():
            tensor.fill_(1.0)
    before = gaussians.map(lambda t: t.detach().clone())
    optimizer.learning_rates["means"] = 0.0  # no noise
    changed, (event,) = control.update(600, gaussians, optimizer)
    assert (event.num_relocated, event.num_added, event.num_gaussians) == (10, 0, 60) and len(changed) == 60
    places = torch.cdist(changed.means, before.means).argmin(dim=1)
    assert torch.equal(changed.means, before.means[places])
    arrivals = torch.bincount(places, minlength=60)
    assert (arrivals[:10] == 0).all() and (arrivals[10:] >= 1).all()
    shared = (arrivals > 1)[places]
    assert torch.equal(changed.logit_opacities[~shared], before.logit_opacities[places[~shared]])
    assert (changed.opacities[shared] < before.opacities[places[shared]]).all()
    assert (optimizer.first["means"][shared] == 0).all()
    assert (optimizer.first["means"][~shared] == 1).all()


def test_growth_stops_at_the_cap():
    gaussians = scene(30)
    control, optimizer = make(gaussians)
    counts = []
    for iteration in range(600, 5_000, 100):
        gaussians, _ = control.update(iteration, gaussians, optimizer)
        counts.append(len(gaussians))
    assert counts[0] == 31 and max(counts) == 100 == counts[-1]
    assert counts == sorted(counts)
    assert all(len(moments["means"]) == 100 for moments in (optimizer.first, optimizer.second))


@pytest.mark.parametrize(
    ("iteration", "due"), [(500, False), (600, True), (650, False), (24_900, True), (25_000, False)]
)
def test_relocation_happens_only_within_its_window(iteration, due):
    gaussians = scene()
    control, optimizer = make(gaussians)
    assert bool(control.update(iteration, gaussians, optimizer)[1]) == due


def test_noise_follows_the_covariance_of_faint_gaussians():
    """The moves of 20,000 copies of a faint Gaussian have the covariance (rate noise gate)² Sigma Sigma."""
    gaussians = scene(1).map(lambda t: t.detach().repeat(20_000, *([1] * (t.ndim - 1))).clone())
    gaussians.log_scales[:] = torch.tensor([-1.0, -2.0, -3.0]).double()
    gaussians.logit_opacities[:] = math.log(0.005 / 0.995)
    gaussians = gaussians.trainable()
    control, optimizer = make(gaussians)
    optimizer.learning_rates["means"] = 1e-6
    before = gaussians.means.detach().clone()
    changed, _ = control.update(0, gaussians, optimizer)
    moves = (changed.means - before).detach().numpy()
    sigma = cov3d_t(gaussians.log_scales[:1], gaussians.quats[:1])[0].detach().numpy()
    expected = (1e-6 * 5e5 * 0.5) ** 2 * sigma @ sigma
    # The relative error of a sample covariance is sqrt(2 / 20,000) = 1 %, of which five are allowed.
    assert np.abs(np.cov(moves.T) - expected).max() < 0.05 * np.abs(expected).max()


def test_noise_does_not_move_opaque_gaussians():
    gaussians = scene()
    with torch.no_grad():
        gaussians.logit_opacities.fill_(3.0)
    control, optimizer = make(gaussians)
    before = gaussians.means.detach().clone()
    changed, _ = control.update(0, gaussians, optimizer)
    assert (changed.means - before).abs().max() < 1e-12


def test_a_scene_of_dead_gaussians_is_kept():
    gaussians = scene()
    with torch.no_grad():
        gaussians.logit_opacities.fill_(-9.0)
    control, optimizer = make(gaussians, TrainConfig(strategy="mcmc", max_gaussians=60))
    changed, (event,) = control.update(600, gaussians, optimizer)
    assert event.num_relocated == 0 and len(changed) == 60


def test_mcmc_needs_a_cap():
    with pytest.raises(ArgumentError, match="^max_gaussians: "):
        MCMC(TrainConfig(strategy="mcmc"), torch.Generator())

"""Splats of a far shell are large, but are neither pruned nor shrunk for their size. Others are treated as usual."""

import numpy as np
import pytest
import torch

from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import recipe
from gsplat_edu.train.density.adc import AdaptiveDensityControl
from gsplat_edu.train.density.mcmc import MCMC
from gsplat_edu.train.far import Shell
from gsplat_edu.train.objective import _MeanScale, make_objective
from gsplat_edu.train.optimizer import Adam

SHELL = Shell(np.array([1.0, 0.0, 0.0]), 300.0)


def scene():
    """Return four Gaussians: a small one, one that is too large, and two of the shell, of which one is faint."""
    return Gaussians(
        means=torch.tensor([[0.0, 0, 0], [1.0, 1, 1], [301.0, 0, 0], [1.0, -300, 0]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1),
        log_scales=torch.tensor([0.01, 5.0, 9.0, 9.0]).log()[:, None].repeat(1, 3),
        sh0=torch.arange(4.0)[:, None, None].repeat(1, 1, 3),
        sh_rest=torch.zeros(4, 0, 3),
        logit_opacities=torch.tensor([0.0, 0.0, 2.0, -9.0]),
    ).trainable()


def test_membership_is_by_distance():
    means = torch.tensor([[1.0, 149.0, 0.0], [1.0, 151.0, 0.0], [1e6, 0.0, 0.0], [-299.0, 0.0, 0.0]])
    assert SHELL.holds(means).tolist() == [False, True, True, True]


@pytest.mark.parametrize(("shell", "left"), [(SHELL, [0.0, 2.0]), (None, [0.0])])
def test_adc_prunes_faint_splats_of_the_shell_but_not_large_ones(shell, left):
    config = recipe(densify_start=99, densify_stop=600, reset_every=50)
    gaussians = scene()
    control = AdaptiveDensityControl(config, 3.0, torch.Generator().manual_seed(0), gaussians, shell)
    changed, _ = control.update(200, gaussians, Adam(gaussians.tensors(), {"means": 1e-3}))
    assert sorted(changed.sh0[:, 0, 0].tolist()) == left


def test_the_scale_of_the_shell_is_not_regularised():
    values = []
    for far in (None, SHELL.holds(scene().means)):
        gaussians = scene()
        value = _MeanScale.apply(gaussians.log_scales, 0.01, far)
        value.backward()
        values.append((float(value.detach()), gaussians.log_scales.grad[:, 0].tolist()))
    (plain, every), (kept, near) = values
    assert plain == pytest.approx(3 * 0.01 * (0.01 + 5 + 9 + 9) / 12)
    assert kept == pytest.approx(3 * 0.01 * (0.01 + 5) / 12)
    assert near == pytest.approx([*every[:2], 0.0, 0.0])
    config = recipe(20, strategy="mcmc", max_gaussians=60)
    assert make_objective(config, SHELL).terms["scale"].shell is SHELL


def test_splits_do_not_let_the_shell_outgrow_the_scene():
    means = torch.zeros(10, 3)
    means[:3, 0] = 400.0
    selected = torch.ones(10, dtype=torch.bool)
    scores = torch.tensor([1.0, 3.0, 2.0, *[0.5] * 7])
    assert SHELL.within_quota(selected, scores, means).tolist() == [False, True, False, *[True] * 7]
    means[3, 0] = 400.0  # 4 of 10 Gaussians
    assert SHELL.within_quota(selected, scores, means).tolist() == [False] * 4 + [True] * 6
    means[:4, 0] = 0.0
    assert SHELL.within_quota(selected, scores, means) is selected


def test_noise_of_mcmc_leaves_the_shell_in_place():
    config = recipe(100, strategy="mcmc", max_gaussians=60)
    for shell in (SHELL, None):
        gaussians = scene()
        before = gaussians.means.detach().clone()
        optimizer = Adam(gaussians.tensors(), {"means": 1.0})
        MCMC(config, torch.Generator().manual_seed(0), shell).update(1, gaussians, optimizer)
        moved = (gaussians.means.detach() != before).any(dim=1).tolist()
        assert moved[3] == (shell is None), "a faint splat of the shell does not move"
        assert moved[0], "a faint splat of the scene moves"

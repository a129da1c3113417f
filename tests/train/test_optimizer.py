import dataclasses

import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.optimizer import Adam

RATES = {"means": 1e-3, "quats": 2e-3, "log_scales": 5e-3, "sh0": 2.5e-3, "logit_opacities": 5e-2}


def start(count=5):
    return random_ball(count, torch.Generator().manual_seed(1), torch.float64).trainable()


def set_gradients(gaussians, generator):
    for tensor in gaussians.tensors().values():
        tensor.grad = torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)


def test_steps_are_those_of_torch():
    ours, theirs = start(), start()
    adam = Adam(ours, RATES)
    oracle = torch.optim.Adam(
        [{"params": [theirs.tensors()[n]], "lr": r} for n, r in RATES.items()], eps=1e-8
    )
    draws = torch.Generator().manual_seed(2), torch.Generator().manual_seed(2)
    for _ in range(20):
        set_gradients(ours, draws[0])
        set_gradients(theirs, draws[1])
        adam.step(ours)
        oracle.step()
    for name, tensor in ours.tensors().items():
        torch.testing.assert_close(tensor, theirs.tensors()[name], rtol=0, atol=1e-14)


def test_gradients_are_dropped_and_parameters_without_one_stay():
    gaussians = start()
    before = gaussians.quats.clone()
    gaussians.means.grad = torch.ones_like(gaussians.means)
    Adam(gaussians, RATES).step(gaussians)
    assert gaussians.means.grad is None
    torch.testing.assert_close(gaussians.quats, before, rtol=0, atol=0)


def test_a_rate_for_something_else_is_refused():
    with pytest.raises(ArgumentError, match="colour"):
        Adam(start(), {"colour": 1.0})


def test_moments_follow_survivors_and_start_at_zero_for_the_newborn():
    gaussians = start()
    adam = Adam(gaussians, RATES)
    set_gradients(gaussians, torch.Generator().manual_seed(3))
    adam.step(gaussians)
    m, v = adam.first["means"].clone(), adam.second["means"].clone()
    adam.follow(torch.tensor([0, 3]), num_new=2)
    assert adam.steps == 1
    torch.testing.assert_close(adam.first["means"], torch.cat([m[[0, 3]], torch.zeros(2, 3).double()]))
    torch.testing.assert_close(adam.second["means"], torch.cat([v[[0, 3]], torch.zeros(2, 3).double()]))


def test_parameters_need_not_be_contiguous_and_autograd_hears_of_the_step():
    gaussians = start()
    strided = dataclasses.replace(gaussians, means=gaussians.means.detach().T.contiguous().T.requires_grad_())
    plain = start()
    for scene in (strided, plain):
        before = scene.means._version
        set_gradients(scene, torch.Generator().manual_seed(5))
        Adam(scene, RATES).step(scene)
        assert scene.means._version > before
    assert not strided.means.is_contiguous()
    torch.testing.assert_close(strided.means, plain.means, rtol=0, atol=1e-15)


def test_moments_that_did_not_follow_are_refused():
    gaussians = start()
    adam = Adam(gaussians, RATES)
    fewer = gaussians.map(lambda tensor: tensor[:3]).trainable()
    set_gradients(fewer, torch.Generator().manual_seed(5))
    with pytest.raises(ArgumentError, match="follow"):
        adam.step(fewer)

import dataclasses

import pytest
import torch

from gsplat_edu import ArgumentError
from gsplat_edu.ops.adam import adam_in_torch, adam_natively
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.optimizer import Adam, ParameterGroup

RATES = {"means": 1e-3, "quats": 2e-3, "log_scales": 5e-3, "sh0": 2.5e-3, "logit_opacities": 5e-2}


def start(count=5):
    return random_ball(count, torch.Generator().manual_seed(1), torch.float64).trainable()


def set_gradients(gaussians, generator):
    for tensor in gaussians.tensors().values():
        tensor.grad = torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)


def test_steps_match_torch():
    ours, theirs = start(), start()
    adam = Adam(ours.tensors(), RATES)
    oracle = torch.optim.Adam(
        [{"params": [theirs.tensors()[n]], "lr": r} for n, r in RATES.items()], eps=1e-8
    )
    draws = torch.Generator().manual_seed(2), torch.Generator().manual_seed(2)
    for _ in range(20):
        set_gradients(ours, draws[0])
        set_gradients(theirs, draws[1])
        adam.step(ours.tensors())
        oracle.step()
    for name, tensor in ours.tensors().items():
        torch.testing.assert_close(tensor, theirs.tensors()[name], rtol=0, atol=1e-14)


def test_gradients_are_dropped_and_parameters_without_one_do_not_move():
    gaussians = start()
    before = gaussians.quats.clone()
    gaussians.means.grad = torch.ones_like(gaussians.means)
    Adam(gaussians.tensors(), RATES).step(gaussians.tensors())
    assert gaussians.means.grad is None
    torch.testing.assert_close(gaussians.quats, before, rtol=0, atol=0)


def test_a_rate_for_an_unknown_parameter_is_refused():
    with pytest.raises(ArgumentError, match="colour"):
        Adam(start().tensors(), {"colour": 1.0})


def test_moments_follow_survivors_and_start_at_zero_for_new_gaussians():
    gaussians = start()
    adam = Adam(gaussians.tensors(), RATES)
    set_gradients(gaussians, torch.Generator().manual_seed(3))
    adam.step(gaussians.tensors())
    m, v = adam.first["means"].clone(), adam.second["means"].clone()
    new = torch.zeros(3).double()
    adam.follow(torch.tensor([3, -1, 0, -1]))
    assert adam.steps == 1
    torch.testing.assert_close(adam.first["means"], torch.stack([m[3], new, m[0], new]))
    torch.testing.assert_close(adam.second["means"], torch.stack([v[3], new, v[0], new]))


def test_strided_parameters_step_in_torch_and_autograd_notices_the_step():
    gaussians = start()
    strided = dataclasses.replace(gaussians, means=gaussians.means.detach().T.contiguous().T.requires_grad_())
    plain = start()
    for scene in (strided, plain):
        before = scene.means._version
        set_gradients(scene, torch.Generator().manual_seed(5))
        kernel = adam_in_torch if scene is strided else adam_natively
        Adam(scene.tensors(), RATES, kernel).step(scene.tensors())
        assert scene.means._version > before
    assert not strided.means.is_contiguous()
    torch.testing.assert_close(strided.means, plain.means, rtol=0, atol=1e-15)


def test_each_group_has_its_own_rate_eps_and_schedule():
    """For a constant gradient g the corrected moments are g and g², so every step is rate g / (|g| + eps)."""
    tensors = {name: torch.zeros(4, dtype=torch.float64).requires_grad_() for name in ("a", "b", "c")}
    groups = {
        "a": ParameterGroup(0.5, eps=3.0),
        "b": ParameterGroup(lambda iteration: 1.0 / (1 + iteration)),
        "c": 0.25,
    }
    adam = Adam(tensors, groups)
    for iteration in range(3):
        for tensor in tensors.values():
            tensor.grad = torch.full_like(tensor, 2.0)
        adam.schedule(iteration)
        adam.step(tensors)
    moved = {name: -float(tensor[0].detach()) for name, tensor in tensors.items()}
    assert moved == pytest.approx({"a": 3 * 0.5 * 2 / (2 + 3), "b": 1 + 1 / 2 + 1 / 3, "c": 3 * 0.25})


def test_groups_that_are_not_per_gaussian_ignore_surgery():
    tensors = {"means": torch.zeros(5, 3).requires_grad_(), "exposures": torch.zeros(2).requires_grad_()}
    adam = Adam(tensors, {"means": 0.1, "exposures": ParameterGroup(0.1, per_gaussian=False)})
    for tensor in tensors.values():
        tensor.grad = torch.ones_like(tensor)
    adam.step(tensors)
    adam.forget_rows(torch.tensor([0, 1]))
    adam.follow(torch.tensor([0, 1, 4, -1, -1, -1, -1]))
    assert adam.first["means"].shape == (7, 3) and (adam.first["means"][[0, 1, 3, 4, 5, 6]] == 0).all()
    assert (adam.first["means"][2] > 0).all()
    assert adam.second["exposures"].shape == (2,) and (adam.second["exposures"] > 0).all()


def test_the_given_kernel_takes_the_steps():
    called = []

    def kernel(parameter, first, second, gradient, numbers):
        called.append((tuple(parameter.shape), numbers.rate, numbers.eps))

    tensors = {"a": torch.zeros(3).requires_grad_(), "b": torch.zeros(2).requires_grad_()}
    tensors["a"].grad = torch.ones(3)
    Adam(tensors, {"a": ParameterGroup(0.5, eps=1e-3), "b": 0.1}, kernel).step(tensors)
    assert called == [((3,), 0.5, 1e-3)], "the kernel is not called for a tensor without a gradient"


def test_parameters_that_do_not_match_the_moments_are_refused():
    gaussians = start()
    adam = Adam(gaussians.tensors(), RATES)
    fewer = gaussians.map(lambda tensor: tensor[:3]).trainable()
    set_gradients(fewer, torch.Generator().manual_seed(5))
    with pytest.raises(ArgumentError, match="follow"):
        adam.step(fewer.tensors())

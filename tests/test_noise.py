"""Noise: published words of Philox, moments of the random numbers, and the native step equals torch and the formula."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu.base.threads import native_threads, one_thread
from gsplat_edu.ops.noise import (
    NoiseNumbers,
    add_noise_in_torch,
    add_noise_natively,
    philox,
    standard_normals,
)
from gsplat_edu.scene.gaussians import cov3d_t
from gsplat_edu.train.initialize import random_ball

NUMBERS = NoiseNumbers(seed=0x0123456789ABCDEF, amount=0.7, sharpness=100.0, threshold=0.005)
LIKE = torch.zeros(0, dtype=torch.float64)


def scene(count, dtype=torch.float64, seed=0):
    """Gaussians of all sizes and rotations, with opacities on both sides of the gate."""
    generator = torch.Generator().manual_seed(seed)
    gaussians = random_ball(count, generator, dtype)
    gaussians.quats[:] = torch.randn(count, 4, generator=generator, dtype=dtype)
    gaussians.logit_opacities[:] = 4 * torch.randn(count, generator=generator, dtype=dtype) - 4
    return gaussians


def moved(gaussians, numbers=NUMBERS, step=add_noise_natively):
    """Return the means after a step, without changing the Gaussians."""
    copy = gaussians.map(lambda tensor: tensor.detach().clone())
    step(copy, numbers)
    return copy.means


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((2**32 - 1,) * 4, (2**32 - 1,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_published_words(counter, key, words):
    """Salmon et al. publish the answers for zeros, ones, and digits of pi with their code."""
    found = philox(tuple(torch.tensor([word]) for word in counter), key)
    assert tuple(int(word) for word in found) == words


def test_normals_have_the_moments_of_the_normal_distribution():
    """Five standard errors are allowed: 1 / sqrt(N) for means, covariances and correlations, sqrt(96 / N) for E n^4 =
    3."""
    count = 200_000
    n = standard_normals(5, count, LIKE).numpy()
    error = 5 / math.sqrt(count)
    assert np.abs(n.mean(axis=0)).max() < error
    assert np.abs(n.T @ n / count - np.eye(3)).max() < math.sqrt(2) * error
    assert np.abs((n**3).mean(axis=0)).max() < math.sqrt(15) * error
    assert np.abs((n**4).mean(axis=0) - 3).max() < math.sqrt(96) * error
    for lag in (1, 2, 64):
        assert np.abs(n[lag:].T @ n[:-lag] / (count - lag)).max() < error
    # the fractions within 1 and 2 standard deviations
    for limit in (1, 2):
        share = math.erf(limit / math.sqrt(2))
        assert abs((np.abs(n) < limit).mean() - share) < 5 * math.sqrt(share * (1 - share) / n.size)


@pytest.mark.parametrize("other", [6, 5 + 2**32, 2**62 + 5])
def test_other_seeds_give_independent_numbers(other):
    a, b = standard_normals(5, 50_000, LIKE), standard_normals(other, 50_000, LIKE)
    assert (a.T @ b / 50_000).abs().max() < 5 / math.sqrt(50_000)


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 4097, 10_001])
@pytest.mark.parametrize("seed", [0, 2**32, 2**63 - 1])
def test_the_native_step_equals_torchs(count, seed):
    """In float64, both round a few dozen operations, on steps up to amount x 5.8 x the largest variance."""
    gaussians, numbers = scene(count), NUMBERS._replace(seed=seed)
    found, truth = moved(gaussians, numbers), moved(gaussians, numbers, add_noise_in_torch)
    torch.testing.assert_close(found, truth, rtol=0, atol=1e-14)
    assert count == 0 or (found != gaussians.means).any()


def test_float32_is_near_float64():
    """The gate's exponent multiplies the opacity's rounding, 1e-7, by the sharpness 100, which is 1e-5 of the step."""
    exact = scene(20_000)
    exact = exact.map(lambda tensor: tensor.float().double())
    rounded = exact.map(lambda tensor: tensor.float())
    rounded.means[:] = 0
    exact.means[:] = 0
    found, truth = moved(rounded).double(), moved(exact)
    in_torch = moved(rounded, step=add_noise_in_torch).double()
    size = NUMBERS.amount * 5.8 * exact.scales.square().amax(dim=1, keepdim=True)
    assert ((found - truth).abs() / size).max() < 1e-5
    assert ((in_torch - truth).abs() / size).max() < 1e-5


def test_the_step_follows_the_formula():
    gaussians = scene(50)
    gate = 1 / (1 + torch.exp(-100 * (0.005 - torch.sigmoid(gaussians.logit_opacities))))
    sigma = cov3d_t(gaussians.log_scales, gaussians.quats)
    n = standard_normals(NUMBERS.seed, 50, LIKE)
    expected = gaussians.means + 0.7 * gate[:, None] * torch.einsum("nij,nj->ni", sigma, n)
    torch.testing.assert_close(moved(gaussians), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_step_does_not_depend_on_threads(dtype):
    gaussians, before, found = scene(20_003, dtype), torch.get_num_threads(), []
    try:
        for count in (1, 2, 5, 64):
            torch.set_num_threads(count)
            found.append(moved(gaussians))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(other, found[0]) for other in found[1:])


def test_native_threads_are_those_outside_one_thread():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with one_thread(), one_thread():
            assert (torch.get_num_threads(), native_threads()) == (1, 3)
        assert (torch.get_num_threads(), native_threads()) == (3, 3)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities"])
def test_an_odd_parameter_moves_only_its_own_gaussian(name, value, dtype):
    """The native step and torch's leave the same rows finite."""
    gaussians = scene(130, dtype)
    changed = gaussians.map(lambda tensor: tensor.clone())
    row = changed.tensors()[name][70]
    row[...] = torch.where(torch.arange(row.numel()).reshape(row.shape) == 0, value, row)
    found, truth = moved(changed), moved(changed, step=add_noise_in_torch)
    others = torch.arange(130) != 70
    assert torch.equal(found[others], moved(gaussians)[others])
    assert torch.equal(found.isfinite().all(dim=1), truth.isfinite().all(dim=1))


def test_a_quaternion_of_zero_length_makes_the_mean_nan():
    gaussians = scene(3)
    gaussians.quats[1] = 0
    assert moved(gaussians).isnan().any(dim=1).tolist() == [False, True, False]


def test_strided_parameters_step_in_torch():
    gaussians = scene(100)
    strided = gaussians.map(lambda tensor: torch.stack([tensor, tensor], dim=-1)[..., 0])
    assert not strided.quats.is_contiguous()
    add_noise_in_torch(strided, NUMBERS)
    torch.testing.assert_close(strided.means, moved(gaussians), rtol=0, atol=1e-14)


def test_a_leaf_moves_and_autograd_knows():
    gaussians = scene(4).trainable()
    version = gaussians.means._version
    add_noise_natively(gaussians, NUMBERS)
    assert gaussians.means._version > version and gaussians.means.requires_grad

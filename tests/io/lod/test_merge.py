"""Pairs of Gaussians are merged into one that keeps their moments."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu.io.lod.merge import Blobs, areas, blobs_of, gaussians_of, halved, merged_pairs
from gsplat_edu.scene.gaussians import Gaussians, cov3d_t
from scene_files import random_scene


def moments(blobs):
    """Return the total weight, and weighted sums of means, second moments about zero, and coefficients."""
    m = blobs.weights
    seconds = blobs.covariances + blobs.means[:, :, None] * blobs.means[:, None, :]
    return (
        m.sum(),
        (m[:, None] * blobs.means).sum(axis=0),
        (m[:, None, None] * seconds).sum(axis=0),
        (m[:, None] * blobs.sh).sum(axis=0),
    )


def lattice(side, gap=1.0, opacity=0.1, rest=3):
    """Return flat splats of size 0.1 to 0.2 on a lattice so wide that none overlap."""
    generator = torch.Generator().manual_seed(0)
    axis = torch.arange(side, dtype=torch.float32)
    means = gap * torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    n = len(means)
    means += 0.2 * torch.rand(n, 3, generator=generator)
    return Gaussians(
        means,
        torch.randn(n, 4, generator=generator),
        torch.log(0.1 + 0.1 * torch.rand(n, 3, generator=generator)),
        torch.randn(n, 1, 3, generator=generator),
        0.2 * torch.randn(n, rest, 3, generator=generator),
        torch.full((n,), math.log(opacity / (1 - opacity))),
    )


def test_areas_are_those_of_the_three_projections():
    """Sigma = R diag(a^2, b^2, c^2) R' has A^2 = a^2 b^2 + b^2 c^2 + c^2 a^2 for every R."""
    gaussians = random_scene(50).gaussians
    a, b, c = np.exp(gaussians.log_scales.double().numpy()).T
    expected = np.sqrt((a * b) ** 2 + (b * c) ** 2 + (c * a) ** 2)
    np.testing.assert_allclose(blobs_of(gaussians).areas, expected, rtol=1e-12)


def test_a_pair_keeps_its_moments():
    """The test computes the moments of each mixture of two splats itself."""
    a, b = blobs_of(random_scene(40, 3, seed=1).gaussians), blobs_of(random_scene(40, 3, seed=2).gaussians)
    merged = merged_pairs(a, b)
    for i in range(40):
        m = a.weights[i], b.weights[i]
        mu = (m[0] * a.means[i] + m[1] * b.means[i]) / sum(m)
        np.testing.assert_allclose(merged.means[i], mu, rtol=1e-12)
        # E[x x'] of the mixture equals that of the merged Gaussian
        second = sum(
            w * (one.covariances[i] + np.outer(one.means[i], one.means[i]))
            for w, one in zip(m, (a, b), strict=True)
        ) / sum(m)
        np.testing.assert_allclose(merged.covariances[i] + np.outer(mu, mu), second, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(merged.sh[i], (m[0] * a.sh[i] + m[1] * b.sh[i]) / sum(m), rtol=1e-10)
        o = 1 - (1 - a.opacities[i]) * (1 - b.opacities[i])
        assert merged.opacities[i] == pytest.approx(min(sum(m) / merged.areas[i], o), rel=1e-12)


def test_merging_two_copies_gives_the_opacity_of_both_composited():
    one = random_scene(1).gaussians
    twice = Gaussians.concatenated([one, one])
    merged, owners = halved(twice)
    assert len(merged) == 1 and owners.tolist() == [0, 0]
    torch.testing.assert_close(merged.means, one.means)
    torch.testing.assert_close(
        cov3d_t(merged.log_scales, merged.quats), cov3d_t(one.log_scales, one.quats), rtol=1e-5, atol=1e-9
    )
    assert float(merged.opacities) == pytest.approx(1 - (1 - float(one.opacities)) ** 2, rel=1e-6)


def test_a_scene_keeps_its_total_moments():
    """The splats do not overlap, so no merge reaches the bound on opacity, and weights add up."""
    gaussians = lattice(6)
    merged, _ = halved(gaussians)
    before, after = moments(blobs_of(gaussians)), moments(blobs_of(merged))
    assert len(merged) == 108
    for a, b in zip(before, after, strict=True):
        # rounding of the parameters to float32
        np.testing.assert_allclose(b, a, rtol=1e-5, atol=1e-6 * before[0])


@pytest.mark.parametrize("count", [0, 1, 2, 3, 10, 501])
def test_half_of_the_splats_remain_and_each_splat_has_an_owner(count):
    gaussians = random_scene(count).gaussians
    merged, owners = halved(gaussians)
    assert len(merged) == (count + 1) // 2
    assert sorted(set(owners.tolist())) == list(range(len(merged)))
    assert all(t.dtype == torch.float32 and bool(t.isfinite().all()) for t in merged.tensors().values())


def test_splats_without_a_partner_keep_their_bits():
    gaussians = random_scene(301).gaussians
    merged, owners = halved(gaussians)
    alone = [row for row in range(301) if (owners == owners[row]).sum() == 1]
    assert len(alone) > 10
    for name, tensor in gaussians.tensors().items():
        np.testing.assert_array_equal(tensor[alone].numpy(), merged.tensors()[name][owners[alone]].numpy())


def test_near_splats_of_similar_colour_merge_first():
    """A blue splat lies among four copies of a red one and is not merged, although it is near."""
    gaussians = lattice(2, gap=0.02)
    red, blue = torch.tensor([1.5, -1.5, -1.5]), torch.tensor([-1.5, -1.5, 1.5])
    sh0 = red.expand(8, 1, 3).clone()
    sh0[3] = blue
    changed = Gaussians(**{**gaussians.tensors(), "sh0": sh0, "sh_rest": torch.zeros(8, 3, 3)})
    merged, owners = halved(changed)
    assert len(merged) == 4 and (owners == owners[3]).sum() == 1
    torch.testing.assert_close(merged.sh0[owners[3], 0], blue)


def test_many_equal_splats_merge():
    one = random_scene(1).gaussians
    merged, _ = halved(Gaussians.concatenated([one] * 100))
    assert len(merged) == 50
    torch.testing.assert_close(merged.means, one.means.expand(50, 3))


def test_extreme_splats_stay_finite():
    """The scene has needles, plates, invisible, huge and far splats, and a quaternion of zeros."""
    gaussians = random_scene(400).gaussians
    gaussians.log_scales[:50, 0] = -80.0
    gaussians.log_scales[50:100] = 80.0
    gaussians.logit_opacities[100:150] = -1e4
    gaussians.logit_opacities[150:200] = 1e4
    gaussians.means[200:220] *= 1e35
    gaussians.quats[220:240] = 0.0
    level = gaussians
    while len(level) > 1:
        level, _ = halved(level)
        assert all(bool(t.isfinite().all()) for t in level.tensors().values()), len(level)


def test_moments_and_parameters_agree():
    gaussians = random_scene(200, 8).gaussians
    again = gaussians_of(blobs_of(gaussians))
    torch.testing.assert_close(
        cov3d_t(again.log_scales, again.quats),
        cov3d_t(gaussians.log_scales, gaussians.quats),
        rtol=1e-4,
        atol=1e-8,
    )
    for name in ("means", "sh0", "sh_rest", "logit_opacities"):
        torch.testing.assert_close(again.tensors()[name], gaussians.tensors()[name])


def test_an_area_of_a_needle_is_positive():
    flat = np.diag([1.0, 1e-30, 1e-30])[None]
    assert areas(flat)[0] > 0
    blobs = Blobs(np.zeros((1, 3)), flat, np.array([0.5]), np.zeros((1, 3)))
    assert bool(gaussians_of(blobs).log_scales.isfinite().all())

"""Grow and shrink select what a comparison of all pairs does, and refuse a radius that takes too many tests."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.records import ABSENT
from gsplat_edu.edits import neighbours, operations as ops
from gsplat_edu.edits.apply import DELETED, HIDDEN, SELECTED, flags_after
from gsplat_edu.edits.cells import MOST_TESTS, EditWork
from gsplat_edu.edits.membership import Values
from gsplat_edu.edits.neighbours import within_radius
from gsplat_edu.edits.runs import check_runs, mask_of, runs_of
from gsplat_edu.scene.gaussians import Gaussians


def by_all_pairs(means, some, others, radius):
    """Compare every splat with every other one."""
    with np.errstate(all="ignore"):
        a, b, c = (means[:, None, i] - means[None, :, i] for i in range(3))
        near = (a * a + b * b) + c * c <= radius * radius
    return some & (near & others).any(axis=1)


def scattered(rng, n, kind):
    """Return centres of a kind, as float32 numbers in float64."""
    means = rng.normal(size=(n, 3))
    if kind == "on a grid":  # many pairs exactly at the radius
        means = rng.integers(-4, 5, (n, 3)).astype(np.float64)
    elif kind == "far apart":  # most cells are the outermost ones
        means *= 10.0 ** rng.uniform(-8, 30, (n, 1))
    elif kind == "odd":
        where = rng.random((n, 3)) < 0.1
        means[where] = rng.choice([np.nan, np.inf, -np.inf, 3e38, -1e-45, 0.0, 1.0], int(where.sum()))
    elif kind == "far from zero":  # the spacing is a few units in the last place
        means = 1e6 + means
    return means.astype(np.float32).astype(np.float64)


KINDS = ("normal", "on a grid", "far apart", "odd", "far from zero")


@pytest.mark.parametrize("kind", KINDS)
def test_the_splats_within_a_radius_are_those_that_all_pairs_give(kind):
    rng, n, some_found = np.random.default_rng(KINDS.index(kind)), 400, 0
    for _ in range(25):
        means = scattered(rng, n, kind)
        some, others = rng.random(n) < 0.6, rng.random(n) < 0.1
        radius = float(rng.choice([1.0, 2.0, 10.0 ** rng.uniform(-9, 1.0), 10.0 ** rng.uniform(-30, 30)]))
        work = EditWork()
        found = within_radius(means, some, others, radius, work)
        expected = by_all_pairs(means, some, others, radius)
        np.testing.assert_array_equal(found, expected, err_msg=f"radius {radius}")
        assert n <= MOST_TESTS - work.left <= n + n * n
        some_found += 0 < expected.sum() < some.sum()
    assert some_found > 3


def test_pairs_that_are_compared_in_parts_give_the_same():
    """Cells as large as the radius hold more pairs than are compared at once."""
    n, radius, work = 6000, 0.6, EditWork()
    means, some = np.random.default_rng(9).uniform(size=(n, 3)), np.arange(n) < n // 2
    means[: n // 3] *= 0.02  # near the corner that others avoid
    means[~some] = 0.4 + 0.6 * means[~some]
    found = within_radius(means, some, ~some, radius, work)
    nearest = cKDTree(means[~some]).query(means[some])[0]
    assert np.abs(nearest - radius).min() > 1e-6, "rounding decides nothing"
    np.testing.assert_array_equal(found[some], nearest <= radius)
    assert not found[~some].any() and 0 < found.sum() < some.sum()
    assert MOST_TESTS - work.left > neighbours.AT_ONCE


def row(n):
    """Splats at x = 0, 1, 2, ..."""
    means = torch.zeros(n, 3)
    means[:, 0] = torch.arange(n)
    return Gaussians(means, torch.ones(n, 4), means - 3, means[:, None], torch.zeros(n, 0, 3), means[:, 0])


def near(x, radius, how="replace"):
    return ops.Select(how, ops.Sphere((float(x), 0.0, 0.0), radius))


S, H, D = SELECTED, HIDDEN, DELETED


@pytest.mark.parametrize(
    ("operations", "flags"),
    [
        ([ops.Grow(9.0), ops.Shrink(9.0)], [0, 0, 0, 0, 0, 0]),
        ([near(2, 0.1), ops.Grow(0.99)], [0, 0, S, 0, 0, 0]),
        ([near(2, 0.1), ops.Grow(1.0)], [0, S, S, S, 0, 0]),
        ([near(2, 0.1), ops.Grow(1.0), ops.Grow(1.0)], [S, S, S, S, S, 0]),
        ([near(2, 2.1), ops.Shrink(1.0)], [S, S, S, S, 0, 0]),
        ([near(3, 0.1), ops.Delete(), near(2, 0.1), ops.Grow(2.0)], [S, S, S, D, S, 0]),
        ([near(3, 0.1), ops.Hide(), near(2, 0.1), ops.Grow(1.0), ops.Show()], [0, S, S, 0, 0, 0]),
        ([near(3, 0.1), ops.Hide(), ops.Select("replace", ops.Everything()), ops.Shrink(1.0)], [S, S, S, H, S, S]),
        ([ops.Select("replace", ops.Distance((1.0, 0.0, 0.0), 1.0, 2.0))], [S, 0, S, S, 0, 0]),
        ([ops.Select("replace", ops.Distance((1.0, 0.0, 0.0), ABSENT, 1.0))], [S, S, S, 0, 0, 0]),
        ([ops.Select("replace", ops.List("here", (1, 2, 5, 1)))], [0, S, S, 0, 0, S]),
        ([near(1, 1.1), ops.Select("intersect", ops.List("here", (1, 2, 5, 1)))], [0, S, S, 0, 0, 0]),
    ],
)  # fmt: skip
def test_growing_shrinking_distances_and_lists_give_these_states(operations, flags):
    assert flags_after(operations, row(6)).tolist() == flags


def test_a_radius_that_takes_too_many_tests_is_refused_before_anything_is_compared():
    n = 64_000  # at one place, so each of one half is compared with all of the other
    means, half = np.zeros((n, 3)), np.arange(n) % 2 == 0
    work = EditWork()
    with pytest.raises(ArgumentError, match=r"a radius of 0\.5 takes 1,024,000,000 tests"):
        within_radius(means, half, ~half, 0.5, work)
    assert MOST_TESTS - work.left == n, "the pairs do not count, because they are not compared"
    with pytest.raises(ArgumentError, match="take more than"):
        within_radius(means[:1000], half[:1000], ~half[:1000], 0.5, EditWork(most=1001))


def test_a_small_radius_is_cheap_beside_an_outlier():
    """One splat far away does not make the cells of all others coarse."""
    means = np.random.default_rng(0).uniform(size=(20_000, 3))
    means[0] = 1e30
    some, work = np.arange(20_000) % 2 == 0, EditWork()
    within_radius(means, some, ~some, 0.02, work)
    assert MOST_TESTS - work.left < 20_000 * 20


@pytest.mark.parametrize("seed", range(4))
def test_runs_and_masks_are_the_same(seed):
    rng = np.random.default_rng(seed)
    for n in (0, 1, 2, 50, 300):
        mask = rng.random(n) < rng.random()
        runs = tuple(runs_of(mask))
        check_runs(runs)
        np.testing.assert_array_equal(mask_of(runs, n), mask)
        assert all(count > 0 for count in runs[1::2]) and len(runs) == 2 * len(runs[::2])


def test_distances_hold_their_ends_and_no_nan():
    means = np.array([(3, 4, 0), (0, 0, 5.0001), (np.nan, 0, 0), (np.inf, 0, 0), (0, 0, 0)], dtype=np.float64)
    values = Values(means, means, means[:, 0], means)
    from gsplat_edu.edits.membership import members

    held = [
        members(ops.Distance((0.0,) * 3, *ends), values).tolist()
        for ends in ((5.0, ABSENT), (ABSENT, 5.0), (0.0, 1e30))
    ]
    assert held == [
        [True, True, False, True, False],
        [True, False, False, False, True],
        [True, True, False, False, True],
    ]

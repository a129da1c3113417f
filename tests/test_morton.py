"""The order along a Morton curve: codes, points with outliers, and points that are not finite."""

import numpy as np
import pytest

from gsplat_edu.scene.morton import morton_codes, order_in_space


def interleaved(row):
    return sum((int(row[axis]) >> bit & 1) << (3 * bit + axis) for bit in range(16) for axis in range(3))


def test_codes_interleave_the_bits():
    cells = np.random.default_rng(0).integers(0, 65536, (300, 3)).astype(np.uint16)
    assert morton_codes(cells).tolist() == [interleaved(row) for row in cells]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [0, 1, 2, 5, 20_000])
def test_the_order_is_a_permutation_for_any_points(count, dtype):
    """The points have NaN, infinities, the largest and the smallest numbers, and some are equal."""
    draw = np.random.default_rng(1)
    points = draw.normal(size=(count, 3)).astype(dtype)
    for value in (np.nan, np.inf, -np.inf, np.finfo(dtype).max, np.finfo(dtype).min, 1e-40, 0.0):
        points[draw.random(points.shape) < 0.05] = value
    with np.errstate(all="raise", under="ignore"):
        assert sorted(order_in_space(points)) == list(range(count))


def test_points_of_the_same_place_keep_their_order():
    for place in (0.0, 7.5, 1e30, -np.inf, np.nan, 1e-40):
        assert order_in_space(np.full((9, 3), place)).tolist() == list(range(9))


def path_length(points):
    """Return the length of the path through the points in the order of `order_in_space`."""
    return np.linalg.norm(np.diff(points[order_in_space(points)], axis=0), axis=1).sum()


def test_neighbours_in_the_order_are_neighbours_in_space():
    """4,096 points in a unit cube are about 1/16 apart, while a random order has steps of 0.66."""
    points = np.random.default_rng(2).random((4096, 3))
    assert path_length(points) < 4096 * 0.12


@pytest.mark.parametrize("far", [1e3, 1e30, np.inf])
def test_outliers_do_not_coarsen_the_grid(far):
    draw = np.random.default_rng(3)
    points = draw.random((4096, 3))
    strays = draw.permutation(4096)[:20]
    points[strays] = far
    order = order_in_space(points)
    inside = points[order[~np.isin(order, strays)]]
    assert np.linalg.norm(np.diff(inside, axis=0), axis=1).sum() < 4096 * 0.13

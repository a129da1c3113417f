"""Regions contain the right splats, in scenes where the answer is obvious."""

import itertools

import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.records import ABSENT
from gsplat_edu.edits import operations as ops
from gsplat_edu.edits.cells import MOST_TESTS, EditWork
from gsplat_edu.edits.document import NEAR
from gsplat_edu.edits.membership import Values, members
from gsplat_edu.scene.gaussians import Gaussians

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
FRONT = ops.Picture((0.0, 0.0, -1.0), AXES, 10.0, 20.0, 5.0, 6.0, 20, 20)
"""The point (x, y, 0) is at depth 1 and appears at pixel (10 x + 5, 20 y + 6)."""


def values_at(*points, log_scales=None, logits=None, sh0=None):
    n = len(points)
    means = np.array(points, dtype=np.float64).reshape(n, 3)
    return Values(
        means,
        np.zeros((n, 3)) if log_scales is None else np.array(log_scales, float),
        np.zeros(n) if logits is None else np.array(logits, float),
        np.zeros((n, 3)) if sh0 is None else np.array(sh0, float),
    )


def held(region, values):
    return members(region, values).tolist()


def test_a_rectangle_holds_its_border_and_nothing_behind_the_camera():
    values = values_at(
        (0, 0, 0), (0.5, 0.2, 0), (0.6, 0, 0), (0, 0.25, 0), (0, 0, -3), (0, 0, -1 + 0.99 * NEAR), (0, 0, 9)
    )
    # at (5, 6), (10, 10), (11, 6) and (5, 11); behind the camera; before the near plane; far away at (5, 6)
    region = ops.PictureRectangle(FRONT, (5.0, 6.0, 10.0, 10.0))
    assert held(region, values) == [True, True, False, False, False, False, True]


def test_a_turned_picture_sees_along_its_axes():
    """The camera looks along +x and its right is -z; the columns are right, down, forward."""
    picture = ops.Picture(
        (0.0, 0.0, 0.0), ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)), 1.0, 1.0, 0.0, 0.0, 9, 9
    )
    values = values_at((2, 0, -2), (2, 0, 2), (2, 2, 0), (-2, 0, 0))
    assert held(ops.PictureRectangle(picture, (0.5, -0.5, 1.5, 0.5)), values) == [True, False, False, False]
    assert held(ops.PictureRectangle(picture, (-0.5, 0.5, 0.5, 1.5)), values) == [False, False, True, False]


def seen(u, v):
    return ((u - 5) / 10, (v - 6) / 20, 0.0)


def test_a_lasso_follows_the_even_odd_rule():
    """The lasso is a bow tie of two triangles that share the point (10, 10); above and below that point is outside."""
    bow = ops.Lasso(FRONT, ((0.0, 0.0), (20.0, 20.0), (20.0, 0.0), (0.0, 20.0)))
    values = values_at(seen(3, 10), seen(17, 10), seen(10, 3), seen(10, 17), seen(-1, 10))
    assert held(bow, values) == [True, True, False, False, False]


def test_a_lasso_around_a_square_with_a_hole_leaves_the_hole():
    """The lasso is the outline of a square, then that of an inner square, which encloses the hole twice."""
    outer, inner = ((0, 0), (9, 0), (9, 9), (0, 9), (0, 0)), ((3, 3), (6, 3), (6, 6), (3, 6), (3, 3))
    region = ops.Lasso(FRONT, tuple((float(u), float(v)) for u, v in (*outer, *inner)))
    values = values_at(seen(1.5, 4.5), seen(4.5, 4.5), seen(7.5, 4.5), seen(4.5, 10))
    assert held(region, values) == [True, False, True, False]


def test_a_brush_is_a_rounded_band():
    """A stroke from (0, 0) to (8, 0) of radius 2 is a capsule; (-1.9, 1.9), inside its bounding box, is 2.7 from the
    end."""
    stroke = ops.Brush(FRONT, 2.0, ((0.0, 0.0), (8.0, 0.0)))
    values = values_at(
        seen(4, 1.9), seen(4, 2.1), seen(-1.9, 0), seen(-1.9, 1.9), seen(9.4, 1.4), seen(9.5, 1.5)
    )
    assert held(stroke, values) == [True, False, True, False, True, False]
    dab = ops.Brush(FRONT, 2.0, ((4.0, 0.0),))
    assert held(dab, values_at(seen(5.9, 0), seen(5.5, 1.5), seen(4, -1.9))) == [True, False, True]


def test_a_sphere_and_a_turned_box_hold_their_borders():
    values = values_at((1, 0, 0), (0, 1.0001, 0), (0.6, 0.6, 0.6))
    assert held(ops.Sphere((0.0, 0.0, 0.0), 1.0), values) == [True, False, False]  # 3 * 0.36 = 1.08
    h = float(np.sqrt(0.5))
    box = ops.Box((0.0, 0.0, 0.0), ((h, -h, 0.0), (h, h, 0.0), (0.0, 0.0, 1.0)), (1.0, 0.1, 0.5))
    corners = values_at(
        (0.7, 0.7, 0.5), (0.72, 0.72, 0), (0.7, -0.7, 0), (0.1, 0.1, 0.51), (-0.7, -0.7, -0.5)
    )
    assert held(box, corners) == [True, False, False, False, True]


def test_values_are_compared_raw_with_both_ends_included():
    values = values_at(
        *[(0, 0, 0)] * 3,
        log_scales=[(-9, -2, -9), (-1, -9, -9), (-9, -9, -3)],
        logits=[-1, 0, 2],
        sh0=[(0, 0, 0), (1, 1, 1), (0, 0, 1.5)],
    )
    assert held(ops.Opacity(0.0, ABSENT), values) == [False, True, True]
    assert held(ops.Opacity(ABSENT, 0.0), values) == [True, True, False]
    assert held(ops.Size(-2.0, -1.0), values) == [True, True, False]
    assert held(ops.Color((0.0,) * 3, (1.0,) * 3), values) == [True, True, False]
    assert held(ops.Everything(), values) == [True] * 3


NAN, INF = np.nan, np.inf


def test_nan_belongs_to_no_region_and_infinity_is_compared():
    values = values_at(
        (NAN, 0, 0), (INF, 0, 0), (0, 0, INF), (0, 0, 0),
        log_scales=[(NAN, 5, 5), (INF, 0, 0), (-INF, -INF, -INF), (5, NAN, 5)],
        logits=[NAN, INF, -INF, 0],
        sh0=[(NAN, 0, 0), (0, INF, 0), (0, 0, -INF), (0, 0, 0)],
    )  # fmt: skip
    box = ops.Box((0.0,) * 3, AXES, (1e30,) * 3)
    assert held(ops.Sphere((0.0,) * 3, 1e30), values) == [False, False, False, True]
    assert held(box, values) == [False, False, False, True]
    for region in (ops.PictureRectangle(FRONT, (-1e6, -1e6, 1e6, 1e6)), ops.Brush(FRONT, 1e6, ((0.0, 0.0),))):
        assert held(region, values)[:2] == [False, False] and held(region, values)[3]
    assert held(ops.Opacity(-1e6, ABSENT), values) == [False, True, False, True]
    assert held(ops.Opacity(ABSENT, 1e6), values) == [False, False, True, True]
    assert held(ops.Size(ABSENT, 1e6), values) == [False, False, True, False]
    assert held(ops.Color((-1e6,) * 3, (1e6,) * 3), values) == [False, False, False, True]


@pytest.mark.parametrize("n", [0, 3])
def test_values_are_those_of_float32(n):
    """A float64 scene is rounded to float32 before comparing, because the page stores float32."""
    third = torch.full((n, 3), 1.0 / 3.0, dtype=torch.float64)
    gaussians = Gaussians(
        third, torch.ones(n, 4).double(), third, third[:, None], torch.zeros(n, 0, 3).double(), third[:, 0]
    )
    values = Values.of(gaussians)
    assert values.means.shape == (n, 3) and values.means.dtype == np.float64
    for array in (values.means, values.log_scales, values.sh0, values.logits):
        assert np.all(array == float(np.float32(1.0 / 3.0)))
    assert len(members(ops.Everything(), values)) == n


def picture_points(rng, n):
    """Splats at random pixels of a picture, many of them at one pixel and some on one line."""
    u, v = rng.uniform(-40, 340, (2, n))
    u[: n // 4], v[: n // 4] = 100.0, 50.0
    u[n // 4 : n // 3] = 200.0
    return values_at(*np.stack([(u - 5) / 10, (v - 6) / 20, np.zeros(n)], axis=1))


def test_lassos_and_strokes_select_the_same_splats_without_cells():
    """The expected answers come from every splat against every edge and segment, as the format defines them."""
    rng, n = np.random.default_rng(3), 500
    values = picture_points(rng, n)
    picture = FRONT
    a, b, c = values.means.T - np.array(picture.position)[:, None]
    u, v = (picture.fx * a) / c + picture.cx, (picture.fy * b) / c + picture.cy
    for count in (3, 4, 60):
        points = rng.uniform(-20, 320, (count, 2)).round(int(rng.integers(0, 3)))
        corners = tuple(map(tuple, points.tolist()))
        odd = np.zeros(n, dtype=bool)
        for (ax, ay), (bx, by) in zip(np.roll(points, 1, axis=0), points, strict=True):
            crossed = (ay > v) != (by > v)
            odd[crossed] ^= u[crossed] < ((bx - ax) * (v[crossed] - ay)) / (by - ay) + ax
        within = (u >= points[:, 0].min()) & (u <= points[:, 0].max())
        within &= (v >= points[:, 1].min()) & (v <= points[:, 1].max())
        np.testing.assert_array_equal(members(ops.Lasso(picture, corners), values), odd & within)
        apart = np.full(n, np.inf)
        for a, b in itertools.pairwise(points):
            place, side = np.stack([u, v], axis=1), b - a
            along = np.clip(((place - a) @ side) / (side @ side), 0, 1)
            apart = np.minimum(apart, np.linalg.norm(place - a - along[:, None] * side, axis=1))
        found = members(ops.Brush(picture, 7.0, corners), values)
        clear = abs(apart - 7.0) > 1e-9  # elsewhere the two formulas may round differently
        np.testing.assert_array_equal(found[clear], (apart < 7.0)[clear])


@pytest.mark.parametrize("kind", ["lasso", "brush"])
def test_a_long_stroke_compares_each_part_with_the_splats_near_it(kind):
    """Each part of a circle of 20,000 points over 20,000 splats touches about two of 64 rows of cells."""
    rng = np.random.default_rng(4)
    values = picture_points(rng, 20_000)
    turn = np.linspace(0, 2 * np.pi, 20_000, endpoint=False)
    points = tuple(map(tuple, np.stack([150 + 140 * np.cos(turn), 100 + 90 * np.sin(turn)], axis=1).tolist()))
    work = EditWork()
    region = ops.Lasso(FRONT, points) if kind == "lasso" else ops.Brush(FRONT, 1.0, points)
    inside = members(region, values, work)
    assert 0 < inside.sum() < len(inside)
    assert MOST_TESTS - work.left < 20_000 * 20_000 / 20


def test_operations_that_take_too_many_tests_are_refused_before_they_are_made():
    """Cells do not help with strokes back and forth across the whole picture, so the number of tests is limited."""
    values = picture_points(np.random.default_rng(5), 1000)
    zigzag = tuple((0.0, 0.0) if i % 2 else (300.0, 200.0) for i in range(20_000))
    for region in (ops.Lasso(FRONT, zigzag), ops.Brush(FRONT, 1e-9, zigzag)):
        with pytest.raises(ArgumentError, match=r"edits: the operations take more than 10,000,000,000 tests"):
            members(region, values, EditWork(most=1_000_000))
    with pytest.raises(ArgumentError, match="tests of a splat"):
        members(ops.Sphere((0.0, 0.0, 0.0), 1.0), values, EditWork(most=999))

"""Views that overlap little need more Gaussians: the plan counts those that show nothing in common."""

import numpy as np
import pytest

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.train.capacity import PLANNED, PLANNED_PIXELS, PLANNED_VIEWS, SEPARATE, planned_gaussians
from gsplat_edu.train.overlap import MOST_VIEWS, separate_views
from lab.captures.room import room_capture


def row(count, step):
    """Cameras in a row that look down at a floor; each sees 2 units of it along the row."""
    eyes = [(step * i, -2.0, 0.0) for i in range(count)]
    cameras = [
        Camera(look_at(eye, (eye[0], 0.0, 0.0), up=(0, 0, 1)), eye, 50.0, 50.0, 24.5, 24.5, 50, 50)
        for eye in eyes
    ]
    rng = np.random.default_rng(0)
    floor = rng.uniform([-1.0, 0.0, -0.5], [step * (count - 1) + 1.0, 0.0, 0.5], (20_000, 3))
    return cameras, floor


@pytest.mark.parametrize(("count", "step"), [(10, 2.0), (10, 1.0), (10, 0.0), (40, 0.5), (3_000, 0.5)])
def test_views_in_a_row_count_by_what_they_show(count, step):
    """The floor that all see, divided by what one sees; a view more or less at the ends."""
    cameras, floor = row(count, step)
    expected = 1.0 + step * (count - 1) / 2.0
    if count > MOST_VIEWS:  # of thinned views, all are separate
        expected = MOST_VIEWS
    assert separate_views(cameras, floor) == pytest.approx(expected, rel=0.04)


def test_the_order_of_views_and_points_does_not_matter():
    cameras, floor = row(30, 0.7)
    assert len(floor[:4_000]) == 4_000
    expected = separate_views(cameras, floor[:4_000])
    order = np.random.default_rng(1).permutation(4_000)
    assert separate_views(cameras[::-1], floor[order]) == expected


def test_orbits_are_one_view_and_rooms_are_many():
    views, points, _ = procedural_capture(48, 24)
    assert 1.0 <= separate_views([view.camera for view in views], points) < SEPARATE
    views, points, _ = room_capture(64, 48, 24)
    assert separate_views([view.camera for view in views], points) > 2 * SEPARATE


def test_without_points_that_a_view_sees_nothing_is_known():
    cameras, _ = row(5, 1.0)
    assert separate_views(cameras, np.zeros((0, 3))) == 1.0
    assert (
        separate_views(cameras, np.array([[0.0, -5.0, 0.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]])) == 1.0
    )


def test_the_planned_number_grows_with_separate_views():
    counts = [
        planned_gaussians(PLANNED_PIXELS, PLANNED_VIEWS, separate)
        for separate in (1.0, SEPARATE, 4.0, 8.0, 85.0)
    ]
    assert counts[0] == counts[1] == PLANNED
    assert counts == sorted(counts) and counts[3] == 2 * PLANNED
    assert planned_gaussians(100 * 100, PLANNED_VIEWS, 8.0) == 2 * 100 * 100, (
        "one Gaussian per pixel of two views"
    )

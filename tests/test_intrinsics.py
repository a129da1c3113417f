"""Intrinsics as a value: scaling, rotating and undistorting a pinhole, and the intrinsics of each camera class."""

import dataclasses

import numpy as np
import pytest

from gsplat_edu import ArgumentError, Camera
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.lens import Lens
from gsplat_edu.io.edit import Similarity
from gsplat_edu.paths.orbits import resized
from gsplat_edu.scene.intrinsics import UNEVEN, Intrinsics

PINHOLE = Intrinsics(40, 30, 50.0, 45.5, 18.25, 16.5)


def test_a_camera_is_a_pose_and_intrinsics():
    camera = Camera(np.eye(3), (1.0, 2.0, 3.0), fx=50.0, fy=45.5, cx=18.25, cy=16.5, H=30, W=40)
    assert camera.intrinsics == PINHOLE
    again = Camera.posed(camera.R, camera.eye, PINHOLE)
    for field in dataclasses.fields(Camera):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(camera, field.name))
    x, y, z = 0.1, -0.2, 2.0
    column, row, one = PINHOLE.K @ np.array([x / z, y / z, 1.0])
    u, v, _ = camera.project((x, y, z))
    # Both are a product and a sum of the same float64 numbers in another order, with two roundings of about 20.
    assert one == 1.0 and abs(column - u) < 1e-14 and abs(row - v) < 1e-14


def test_scaling_keeps_the_edges_of_the_image_in_place():
    """The directions through the edges, half a pixel beyond the outermost centres, do not change."""
    small = PINHOLE.scaled(20, 10)
    for side, other in ((0.0, 0.0), (1.0, 1.0)):
        assert (side * 40 - 0.5 - PINHOLE.cx) / PINHOLE.fx == pytest.approx(
            (other * 20 - 0.5 - small.cx) / small.fx, rel=1e-14
        )
        assert (side * 30 - 0.5 - PINHOLE.cy) / PINHOLE.fy == pytest.approx(
            (other * 10 - 0.5 - small.cy) / small.fy, rel=1e-14
        )
    assert small.scaled(40, 30) == PINHOLE, "scaling by powers of two is exact"


def test_a_lens_is_intrinsics_with_distortion():
    lens = Lens(40, 30, 50.0, 45.5, 18.25, 16.5, (-0.05, 0.01))
    assert isinstance(lens, Intrinsics) and lens != PINHOLE
    half = lens.scaled(20, 15)
    assert isinstance(half, Lens) and half.coefficients == lens.coefficients
    straight = lens.undistorted()
    assert type(straight) is Intrinsics and straight.undistorted() is straight
    assert (straight.W, straight.H) == (40, 30) and straight.fx / straight.fy == pytest.approx(50.0 / 45.5)
    assert Lens(40, 30, 50.0, 45.5, 18.25, 16.5).undistorted() == PINHOLE


def test_turning_four_times_changes_nothing():
    assert PINHOLE.turned(1) == Intrinsics(30, 40, 45.5, 50.0, 12.5, 18.25)
    assert PINHOLE.turned(4) == PINHOLE == PINHOLE.turned(1).turned(3)


@pytest.mark.parametrize(("fy", "uneven"), [(50.0, False), (46.0, False), (45.0, True), (56.0, True)])
def test_pixels_are_square_up_to_a_bound(fy, uneven):
    assert UNEVEN == 1.1
    assert Intrinsics(40, 30, 50.0, fy, 20.0, 15.0).uneven is uneven
    assert Lens(40, 30, 50.0, fy, 20.0, 15.0).uneven is uneven


@pytest.mark.parametrize(
    "change", [{"W": 0}, {"H": -1}, {"fx": 0.0}, {"fy": -2.0}, {"cx": float("nan")}, {"fx": float("inf")}]
)
def test_implausible_values_are_refused(change):
    (name,) = change
    with pytest.raises(ArgumentError, match=f"^{name}: is "):
        dataclasses.replace(PINHOLE, **change)
    with pytest.raises(DatasetError):
        dataclasses.replace(Lens(40, 30, 50.0, 45.5, 18.25, 16.5), **change)


class OtherCamera:
    """A camera of another class, with the members of `CameraLike` only."""

    R, eye = np.eye(3), np.array([0.0, 0.0, -3.0])
    fx, fy, cx, cy, H, W = 50.0, 45.5, 18.25, 16.5, 30, 40


@pytest.mark.usefixtures("as_shipped")  # otherwise the hook checks annotations
def test_cameras_of_other_classes_are_resized_and_moved():
    assert resized(OtherCamera(), 20).intrinsics == PINHOLE.scaled(20, 15)
    moved = Similarity(np.eye(3), 2.0, np.array([1.0, 0.0, 0.0])).camera(OtherCamera())
    assert moved.intrinsics == PINHOLE
    np.testing.assert_array_equal(moved.eye, [1.0, 0.0, -6.0])

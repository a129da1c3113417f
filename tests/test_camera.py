import numpy as np
import pytest

from gsplat_edu import ArgumentError, Camera, look_at, orbit_camera


def test_look_at_along_z_is_the_identity():
    np.testing.assert_allclose(look_at((0, 0, -3), (0, 0, 0)), np.eye(3), rtol=0, atol=1e-15)


def test_look_at_rows_are_right_down_forward():
    rng = np.random.default_rng(0)
    for eye, target in rng.normal(size=(50, 2, 3)):
        R = look_at(eye, target)
        np.testing.assert_allclose(R @ R.T, np.eye(3), rtol=0, atol=1e-14)
        assert np.linalg.det(R) > 0
        np.testing.assert_allclose(
            R @ (target - eye), [0, 0, np.linalg.norm(target - eye)], rtol=0, atol=1e-14
        )
        assert abs(R[0] @ (0, -1, 0)) < 1e-14, "right is level"
        assert R[1] @ (0, -1, 0) < 0, "down points away from up"


def test_looking_at_centres_the_target_with_up_at_the_top():
    cam = Camera.looking_at(eye=(1, -2, -3), target=(0.5, 0, 1), fx=100, fy=90, H=60, W=80)
    u, v, z = cam.project(cam.world_to_cam([(0.5, 0, 1), (0.5, -0.1, 1)]))
    np.testing.assert_allclose((u[0], v[0]), (40, 30), rtol=0, atol=1e-12)
    assert v[1] < v[0]
    np.testing.assert_allclose(z[0], np.linalg.norm([-0.5, 2, 4]))


def test_up_determines_the_roll_of_the_image():
    upright = Camera.looking_at((0, 0, -3), (0, 0, 0), 10, 10, 8, 8)
    turned = Camera.looking_at((0, 0, -3), (0, 0, 0), 10, 10, 8, 8, up=(1, 0, 0))
    u, v, _ = upright.project(upright.world_to_cam((1, 0, 0)))
    assert (u > 4) and v == 4
    u, v, _ = turned.project(turned.world_to_cam((1, 0, 0)))
    assert abs(u - 4) < 1e-12 and v < 4, "the old right is now up"


def test_project_is_a_pinhole_and_keeps_leading_axes():
    cam = Camera(np.eye(3), (0, 0, 0), fx=10, fy=20, cx=3, cy=4, H=5, W=6)
    points = np.array([[[1.0, 2.0, 4.0]], [[-1.0, 0.5, 2.0]]])
    u, v, z = cam.project(points)
    assert u.shape == v.shape == z.shape == (2, 1)
    np.testing.assert_array_equal(u[:, 0], [10 / 4 + 3, -10 / 2 + 3])
    np.testing.assert_array_equal(v[:, 0], [40 / 4 + 4, 10 / 2 + 4])
    np.testing.assert_array_equal(z[:, 0], [4, 2])


def test_points_that_are_not_in_front_have_no_image():
    cam = Camera(np.eye(3), (0, 0, 0), 10, 10, 3, 3, 6, 6)
    u, v, z = cam.project([(1, 1, 0), (1, 1, -2), (0, 0, 1)])
    np.testing.assert_array_equal(np.isnan(u), [True, True, False])
    np.testing.assert_array_equal(np.isnan(v), [True, True, False])
    np.testing.assert_array_equal(z, [0, -2, 1])


def test_a_camera_keeps_its_own_read_only_copies():
    R, eye = np.eye(3), np.zeros(3)
    cam = Camera(R, eye, 1, 1, 0, 0, 2, 2)
    R[0, 0] = eye[0] = 7.0
    assert cam.R[0, 0] == 1.0 and cam.eye[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        cam.R[0, 0] = 2.0


def test_orbit_camera_is_on_its_sphere_and_looks_at_the_centre():
    for azimuth in np.linspace(0, 6, 7):
        cam = orbit_camera(azimuth, 0.3, size=32, fx=40, radius=2.5)
        np.testing.assert_allclose(np.linalg.norm(cam.eye), 2.5)
        np.testing.assert_allclose(cam.world_to_cam((0, 0, 0)), (0, 0, 2.5), rtol=0, atol=1e-14)
    np.testing.assert_allclose(orbit_camera(0, 0, 32, 40).eye, (0, 0, -3))
    assert orbit_camera(0, 0.3, 32, 40).eye[1] > 0, "positive elevation is +y, which is down"
    with pytest.raises(ArgumentError, match="up"):
        orbit_camera(0, np.pi / 2, 32, 40)

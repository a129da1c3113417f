import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.edit import Similarity
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.sfm.align import upright


def ring(count=8, radius=3.0, height=1.0, inwards=True):
    """Return level cameras on a circle that look at the origin, or outwards, as from the middle of a room."""
    cameras = []
    for angle in 2 * np.pi * np.arange(count) / count:
        eye = np.array([radius * np.sin(angle), -height, -radius * np.cos(angle)])
        target = np.zeros(3) if inwards else 2 * eye + [0.0, height, 0.0]
        cameras.append(Camera(look_at(eye, target), eye, 100.0, 100.0, 49.5, 49.5, 100, 100))
    return cameras


POINTS = np.random.default_rng(0).normal(0, 0.3, (200, 3))
MOVE = Similarity(Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix(), 0.37, np.array([5.0, -3.0, 80.0]))


def test_cameras_are_level_five_away_and_look_at_the_origin():
    moved = [MOVE.camera(camera) for camera in ring()]
    points = MOVE.s * POINTS @ MOVE.R.T + MOVE.t
    back = upright(moved, points)
    np.testing.assert_allclose(back.R @ back.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(back.R) > 0
    cameras = [back.camera(camera) for camera in moved]
    for camera in cameras:
        np.testing.assert_allclose(camera.R[0, 1], 0.0, atol=1e-9, err_msg="right is level")
        np.testing.assert_allclose(np.linalg.norm(camera.eye), 5.0, rtol=1e-9)
        assert camera.eye[1] < 0, "above its target, because y points down"
    assert abs(cameras[0].R[2, 0]) < 1e-9 and cameras[0].R[2, 2] > 0


def test_cameras_that_look_outwards_are_centred_and_walls_are_five_away():
    rng = np.random.default_rng(1)
    walls = rng.normal(size=(2000, 3))
    walls *= 20.0 / np.linalg.norm(walls, axis=1, keepdims=True)
    cameras = ring(radius=0.3, height=0.0, inwards=False)
    move = upright(cameras, walls)
    eyes = np.stack([move.camera(camera).eye for camera in cameras])
    np.testing.assert_allclose(eyes.mean(axis=0), 0.0, atol=1e-9)
    # The image shows 26 degrees to each side. A sphere of radius 20, seen from near its centre, has depths of 16 to 20.
    assert 5 / 20 <= move.s <= 5 / 16


def test_a_camera_looking_straight_down_is_aligned():
    eye = np.array([0.0, -3.0, 0.0])
    camera = Camera(look_at(eye, np.zeros(3), up=(0.0, 0.0, 1.0)), eye, 100.0, 100.0, 49.5, 49.5, 100, 100)
    move = upright([camera], POINTS)
    assert np.isfinite(move.R).all() and np.isfinite(move.t).all()
    np.testing.assert_allclose(move.R @ move.R.T, np.eye(3), atol=1e-12)


def test_aligning_no_cameras_or_no_points_is_refused():
    with pytest.raises(ArgumentError, match="empty"):
        upright([], POINTS)
    with pytest.raises(ArgumentError, match="empty"):
        upright(ring(), np.zeros((0, 3)))

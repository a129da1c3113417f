import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gsplat_edu.camera import Camera, look_at
from gsplat_edu.errors import ArgumentError
from gsplat_edu.evaluate.paths import orbit_of_scene, orbit_path, resized
from gsplat_edu.gaussians import Gaussians

SUBJECT = np.array([3.0, -20.0, 7.0])


def turned(seed):
    return Rotation.random(random_state=seed).as_matrix()


def ring(count=12, radius=2.5, elevation=0.4, frame=None, spread=0.0):
    """Cameras around the subject at one elevation; the frame turns their world, up included."""
    frame = np.eye(3) if frame is None else frame
    rng = np.random.default_rng(0)
    cameras = []
    for angle in np.linspace(0, 1.5 * np.pi, count):
        level = np.array([np.sin(angle), 0.0, -np.cos(angle)])
        offset = radius * (math.cos(elevation) * level + math.sin(elevation) * np.array([0.0, -1.0, 0.0]))
        target = SUBJECT + frame @ (spread * rng.normal(size=3))
        eye = SUBJECT + frame @ offset
        R = look_at(eye, target, frame @ np.array([0.0, -1.0, 0.0]))
        cameras.append(Camera(R, eye, 80, 85, 30.5, 22.0, 48, 64))
    return cameras


def image_of(camera, point):
    u, v, z = camera.project(camera.world_to_cam(point))
    return float(u), float(v), float(z)


@pytest.mark.parametrize("frame", [None, turned(1), turned(2)])
def test_an_orbit_keeps_the_subject_in_the_centre(frame):
    orbit = orbit_path(ring(frame=frame), 20)
    assert len(orbit) == 20
    up = (np.eye(3) if frame is None else frame) @ np.array([0.0, -1.0, 0.0])
    for camera in orbit:
        assert image_of(camera, SUBJECT) == pytest.approx((30.5, 22.0, 2.5), abs=1e-6)
        # not rolled: up in the world is up in the image, and the elevation is the cameras'
        assert abs(camera.R[0] @ up) < 1e-9
        assert (camera.eye - SUBJECT) @ up / 2.5 == pytest.approx(math.sin(0.4), abs=1e-6)
        assert (camera.fx, camera.fy, camera.H, camera.W) == (80, 85, 48, 64)


def test_an_orbit_is_closed_and_starts_at_the_first_camera():
    cameras = ring()
    orbit = orbit_path(cameras, 8)
    np.testing.assert_allclose(orbit[0].eye, cameras[0].eye, atol=1e-9)
    steps = [np.linalg.norm(b.eye - a.eye) for a, b in zip(orbit, orbit[1:] + orbit[:1], strict=True)]
    np.testing.assert_allclose(steps, 2 * 2.5 * math.cos(0.4) * math.sin(math.pi / 8), rtol=1e-9)


def test_cameras_that_look_about_still_find_the_subject():
    """Targets scatter by 0.1 around the subject: the least-squares point of 40 axes is within a few 0.1 / sqrt(40)."""
    orbit = orbit_path(ring(count=40, spread=0.1), 4)
    centre = np.mean([camera.eye for camera in orbit], axis=0) - np.array([0, -2.5 * math.sin(0.4), 0])
    assert np.linalg.norm(centre - SUBJECT) < 0.1


@pytest.mark.parametrize("count", [1, 3])
def test_one_camera_or_parallel_ones_orbit_a_point_in_front(count):
    R = turned(3)
    cameras = [Camera(R, R[0] * i, 50, 50, 10, 10, 21, 21) for i in range(count)]
    orbit = orbit_path(cameras, 6, depth=4.0)
    point = R[0] * (count - 1) / 2 + 4.0 * R[2]
    for camera in orbit:
        u, v, _ = image_of(camera, point)
        assert (u, v) == pytest.approx((10, 10), abs=1e-6)


def test_cameras_that_look_outwards_orbit_a_point_in_front():
    cameras = []
    for angle in np.linspace(0, np.pi / 2, 5):  # a quarter of a panorama
        forward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        cameras.append(Camera(look_at(0.5 * forward, 2 * forward), 0.5 * forward, 50, 50, 10, 10, 21, 21))
    centre = np.mean([camera.eye for camera in orbit_path(cameras, 8, depth=4.0)], axis=0)
    assert centre @ np.array([1, 0, 1]) / math.sqrt(2) > 4.0


def test_cameras_straight_above_are_no_obstacle():
    above = Camera(look_at((0, -3, 0), (0, 0, 0), (0, 0, 1)), (0, -3, 0), 50, 50, 10, 10, 21, 21)
    orbit = orbit_path([above, *ring()[:0]], 5, depth=3.0)
    assert all(image_of(camera, (0, 0, 0))[:2] == pytest.approx((10, 10), abs=1e-6) for camera in orbit)


def test_no_camera_or_no_frame_is_refused():
    with pytest.raises(ArgumentError, match="cameras: is empty"):
        orbit_path([], 3)
    with pytest.raises(ArgumentError, match="frames: is 0"):
        orbit_path(ring(), 0)


def scene(means, logit):
    count = len(means)
    return Gaussians(
        means=torch.tensor(means, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4).clone(),
        log_scales=torch.full((count, 3), -3.0),
        sh0=torch.zeros(count, 1, 3),
        sh_rest=torch.zeros(count, 0, 3),
        logit_opacities=torch.as_tensor(logit, dtype=torch.float32).expand(count).clone(),
    )


def test_a_bare_scene_fills_the_picture_whatever_floats_around():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2000, 3))
    ball = 0.5 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + (4, 5, 6)
    floaters = rng.uniform(-500, 500, (1500, 3))  # many, but faint
    gaussians = scene(np.concatenate([ball, floaters]), np.r_[np.full(2000, 4.0), np.full(1500, -5.0)])
    for camera in orbit_of_scene(gaussians, 7, 100):
        u, v, _ = camera.project(camera.world_to_cam(ball))
        assert (camera.W, camera.H) == (100, 100)
        # the medians of 2000 points are some 0.5 / sqrt(2000) off, under 3 px here; so are the edges
        assert abs(u.mean() - 50) < 3 and abs(v.mean() - 50) < 3
        assert u.min() > -3 and u.max() < 103 and u.max() - u.min() > 80
        assert camera.eye[1] < 5, "from above"


def test_one_gaussian_is_a_scene_and_none_is_not():
    (camera,) = orbit_of_scene(scene([[1.0, 2.0, 3.0]], 0.0), 1, 10)
    assert image_of(camera, (1, 2, 3))[:2] == pytest.approx((5, 5), abs=1e-6)
    with pytest.raises(ArgumentError, match="gaussians: is empty"):
        orbit_of_scene(scene(np.zeros((0, 3)), 0.0), 1, 10)


def test_resizing_keeps_what_is_seen():
    camera = Camera(np.eye(3), (0, 0, 0), 80, 85, 30.5, 22.0, 48, 64)
    small = resized(camera, 32)
    assert (small.W, small.H) == (32, 24)
    point = (0.13, -0.07, 1.9)
    (u, v, _), (su, sv, _) = image_of(camera, point), image_of(small, point)
    assert (su + 0.5, sv + 0.5) == pytest.approx(((u + 0.5) / 2, (v + 0.5) / 2))

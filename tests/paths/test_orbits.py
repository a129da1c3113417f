import numpy as np
import pytest
import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.paths.orbits import orbit_of_scene, resized
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians


def image_of(camera, point):
    u, v, z = camera.project(camera.world_to_cam(point))
    return float(u), float(v), float(z)


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


def test_a_scene_without_cameras_fills_the_picture_despite_floaters():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2000, 3))
    ball = 0.5 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + (4, 5, 6)
    floaters = rng.uniform(-500, 500, (1500, 3))  # many, but faint
    gaussians = scene(np.concatenate([ball, floaters]), np.r_[np.full(2000, 4.0), np.full(1500, -5.0)])
    for camera in orbit_of_scene(gaussians, 7, 100):
        u, v, _ = camera.project(camera.world_to_cam(ball))
        assert (camera.W, camera.H) == (100, 100)
        # The medians of 2000 points have errors of about 0.5 / sqrt(2000), below 3 px, as do the edges.
        assert abs(u.mean() - 50) < 3 and abs(v.mean() - 50) < 3
        assert u.min() > -3 and u.max() < 103 and u.max() - u.min() > 80
        assert camera.eye[1] < 5, "the camera is above the scene"


def test_one_gaussian_has_an_orbit_and_an_empty_scene_has_none():
    (camera,) = orbit_of_scene(scene([[1.0, 2.0, 3.0]], 0.0), 1, 10)
    assert image_of(camera, (1, 2, 3))[:2] == pytest.approx((5, 5), abs=1e-6)
    with pytest.raises(ArgumentError, match="gaussians: is empty"):
        orbit_of_scene(scene(np.zeros((0, 3)), 0.0), 1, 10)


def test_resizing_keeps_the_view():
    camera = Camera(np.eye(3), (0, 0, 0), 80, 85, 30.5, 22.0, 48, 64)
    small = resized(camera, 32)
    assert (small.W, small.H) == (32, 24)
    point = (0.13, -0.07, 1.9)
    (u, v, _), (su, sv, _) = image_of(camera, point), image_of(small, point)
    assert (su + 0.5, sv + 0.5) == pytest.approx(((u + 0.5) / 2, (v + 0.5) / 2))


def test_a_far_sky_does_not_move_the_orbit():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2000, 3)) + np.array([4, 5, 6])
    sky = rng.normal(size=(1500, 3)) * (1, -1, 1)
    sky[:, 1] = -abs(sky[:, 1])
    sky = 400 * sky / np.linalg.norm(sky, axis=1, keepdims=True)
    alone, both = (orbit_of_scene(scene(means, 2.0), 3, 50) for means in (ball, np.concatenate([sky, ball])))
    for one, other in zip(alone, both, strict=True):
        np.testing.assert_allclose(one.eye, other.eye)

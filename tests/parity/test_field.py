"""Splats that a pinhole leaves out of a scene that was trained through lenses."""

import dataclasses
import math

import numpy as np
import torch

from gsplat_edu import Camera
from gsplat_edu.render.field import BEYOND, LEAST_BEYOND, field_of, within_field
from gsplat_edu.scene.projection import Projection
from splat_ball import ball


def test_means_are_shown_up_to_twice_the_field_and_at_least_to_50_degrees():
    wide = Camera(np.eye(3), np.zeros(3), 40, 40, 29.5, 19.5, 40, 60)
    assert np.allclose(field_of(wide), [BEYOND * 30 / 40, max(BEYOND * 20 / 40, LEAST_BEYOND)])
    narrow = Camera(np.eye(3), np.zeros(3), 400, 400, 29.5, 19.5, 40, 60)
    assert field_of(narrow) == (math.tan(math.radians(50)),) * 2
    aside = Camera(np.eye(3), np.zeros(3), 40, 40, 0.5, 19.5, 40, 60)
    assert np.isclose(field_of(aside)[0], BEYOND * 59 / 40)


def test_what_is_left_out():
    camera = Camera.looking_at((0.3, -0.2, -2.0), (0, 0, 0.5), 30, 30, 40, 60)
    gaussians = ball()
    x, y = field_of(camera)
    moved = dataclasses.replace(gaussians, means=gaussians.means * 4)
    points = camera.world_to_cam(moved.means.numpy().astype(np.float64))
    expected = (np.abs(points[:, 0]) <= x * points[:, 2]) & (np.abs(points[:, 1]) <= y * points[:, 2])
    assert 100 < expected.sum() < len(expected) - 100
    assert torch.equal(within_field(moved, camera).means, moved.means[torch.from_numpy(expected)])
    assert within_field(moved, camera.through(Projection("fisheye"))) is moved

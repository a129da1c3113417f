"""Counts of cameras that see a splat equal those of renders in which this splat alone is white."""

import dataclasses

import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import C0
from gsplat_edu.clean.sight import SEEN, times_seen
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import Projection

from .conftest import CPU

SETTINGS = RenderSettings(depth=False, sh_degree=0)

COUNT = 40


@pytest.fixture(scope="module")
def scene():
    """Splats of all opacities, many of them behind others."""
    rng = np.random.default_rng(11)
    return Gaussians(
        means=torch.tensor(rng.uniform(-0.5, 0.5, (COUNT, 3))),
        quats=torch.tensor(rng.normal(size=(COUNT, 4))),
        log_scales=torch.tensor(np.log(rng.uniform(0.03, 0.4, (COUNT, 3)))),
        sh0=torch.zeros(COUNT, 1, 3, dtype=torch.float64),
        sh_rest=torch.zeros(COUNT, 0, 3, dtype=torch.float64),
        logit_opacities=torch.tensor(rng.uniform(-2, 6, COUNT)),
    )


def cameras(projection=None):
    eyes = [(0.2, -0.1, -2.0), (1.9, 0.3, 0.4), (-0.7, -1.2, 1.6), (0.1, 1.8, -0.3)]
    found = [Camera(look_at(eye, (0, 0, 0)), eye, 40.0, 44.0, 19.4, 15.2, 32, 40) for eye in eyes]
    return found if projection is None else [camera.through(projection) for camera in found]


def weights_alone(scene, camera, splat):
    """Return the weights of a splat: the picture if it is white and all others are black."""
    sh0 = torch.full_like(scene.sh0, -0.5 / C0)
    sh0[splat] = 0.5 / C0
    with torch.no_grad():
        return render(dataclasses.replace(scene, sh0=sh0), camera, settings=SETTINGS, backend="cpu").image[
            ..., 0
        ]


@pytest.mark.parametrize("lens", [None, Projection("fisheye")])
def test_counts_are_those_of_splats_rendered_white_one_by_one(scene, lens):
    views = cameras(lens)
    opacities = scene.opacities.numpy()
    expected, ties = np.zeros(COUNT, dtype=int), np.zeros(COUNT, dtype=bool)
    for camera in views:
        peaks = np.array([float(weights_alone(scene, camera, i).max()) for i in range(COUNT)])
        expected += (peaks > 0) & (peaks >= SEEN * opacities)
        ties |= abs(peaks - SEEN * opacities) < 1e-5
    found = times_seen(scene, views, SETTINGS, CPU)
    assert not ties.any(), "the scene has a splat at the threshold; choose another seed"
    assert {0, 4} < set(expected), "some splats are hidden from all cameras, some from none"
    np.testing.assert_array_equal(found, expected)


def test_what_lies_behind_a_wall_is_not_seen(scene):
    wall = Gaussians(
        means=torch.tensor([[0.0, 0.0, -1.0]] * 3 + [[0.0, 0.0, 1.0]], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 4, dtype=torch.float64),
        log_scales=torch.log(torch.tensor([[5.0, 5.0, 0.01]] * 3 + [[0.1] * 3], dtype=torch.float64)),
        sh0=torch.zeros(4, 1, 3, dtype=torch.float64),
        sh_rest=torch.zeros(4, 0, 3, dtype=torch.float64),
        logit_opacities=torch.tensor([6.0, 6.0, 6.0, 6.0], dtype=torch.float64),
    )
    front, back = (
        Camera(look_at(eye, (0, 0, 0)), eye, 40.0, 40.0, 20.0, 20.0, 40, 40)
        for eye in ((0, 0, -3), (0, 0, 3))
    )
    assert times_seen(wall, [front], SETTINGS, CPU)[[0, 3]].tolist() == [1, 0]
    assert times_seen(wall, [front, back], SETTINGS, CPU)[3] == 1


def test_progress_is_told_for_every_camera(scene):
    told = []
    times_seen(scene, cameras(), SETTINGS, CPU, lambda: told.append(1))
    assert len(told) == 4

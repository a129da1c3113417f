"""Splats of the sky: their places, shapes, colours and number."""

import math

import numpy as np
import pytest
import torch

from gsplat_edu.parts.sky.find import Sky, fibonacci
from gsplat_edu.parts.sky.shell import FLATNESS, OPACITY, sky_splats
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import quat_to_R_t
from gsplat_edu.train.far import Shell

CENTRE, RADIUS = np.array([1.0, 2.0, 3.0]), 500.0


def hemisphere(count=40_000):
    directions = fibonacci(2 * count)
    directions = directions[directions[:, 1] < 0]
    colors = 0.5 + 0.4 * directions
    return Sky(
        np.array([0.0, -1.0, 0.0]),
        directions,
        colors,
        np.zeros(len(directions), int),
        0.5,
        0.0,
        1.0,
        5.0,
        0.01,
    )


@pytest.fixture(scope="module")
def splats():
    return sky_splats(hemisphere(), Shell(CENTRE, RADIUS), 1)


def test_splats_lie_on_the_shell_where_the_sky_is(splats):
    offsets = splats.means.double().numpy() - CENTRE
    assert np.linalg.norm(offsets, axis=1) == pytest.approx(np.full(len(offsets), RADIUS), rel=1e-6)
    assert offsets[:, 1].max() < RADIUS * math.sin(0.05)
    assert 2_500 < len(splats) <= 3_000 and splats.sh_rest.shape == (len(splats), 3, 3)
    assert bool(Shell(CENTRE, RADIUS).holds(splats.means).all())
    assert not bool(
        Shell(CENTRE, RADIUS).holds(torch.tensor(CENTRE[None] + 0.4 * RADIUS / math.sqrt(3))).any()
    )


def test_splats_are_flat_and_face_the_centre(splats):
    axes = quat_to_R_t(splats.quats)[:, :, 2].double().numpy()
    outward = (splats.means.double().numpy() - CENTRE) / RADIUS
    assert np.abs((axes * outward).sum(axis=1)) == pytest.approx(np.ones(len(axes)), abs=1e-5)
    scales = splats.scales.numpy()
    assert np.allclose(scales[:, 2] / scales[:, 0], FLATNESS) and np.allclose(scales[:, 0], scales[:, 1])
    assert torch.sigmoid(splats.logit_opacities).numpy() == pytest.approx(np.full(len(axes), OPACITY))


def test_splats_show_the_sky_without_gaps(splats):
    camera = Camera.looking_at(CENTRE, CENTRE + np.array([0.0, -1.0, 0.8]), 60, 60, 64, 64)
    output = render(splats, camera, settings=RenderSettings(jacobian_limit=1.3), backend="cpu")
    assert float(output.transmittance.max()) < 0.1
    u, v = np.meshgrid(np.arange(64), np.arange(64))
    rays = np.stack([(u - camera.cx) / 60, (v - camera.cy) / 60, np.ones(u.shape)], axis=-1) @ camera.R
    wanted = 0.5 + 0.4 * rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    assert np.abs(output.image.numpy() - wanted).max() < 0.08


def test_the_number_of_splats_is_capped_but_fine_enough_for_small_skies():
    few = sky_splats(hemisphere(), Shell(CENTRE, RADIUS), 0, most=40)
    assert 20 < len(few) <= 40
    sky = hemisphere()
    patch = sky.directions[:, 1] < -0.995  # a sky of 6 degrees around the zenith
    small = Sky(sky.up, sky.directions[patch], sky.colors[patch], sky.photo[patch], 0.01, 0.0, 1.0, 5.0, 0.01)
    count = len(sky_splats(small, Shell(CENTRE, RADIUS), 0))
    assert 60 < count < 400, "splats a degree apart, instead of 3,000"
    dot = Sky(sky.up, sky.directions[:1], sky.colors[:1], sky.photo[:1], 1e-6, 0.0, 0.0, 0.0, 1e-4)
    assert len(sky_splats(dot, Shell(CENTRE, RADIUS), 0, most=5)) >= 1

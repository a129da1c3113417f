"""Cameras, sky, points and colours of the ray-traced capture agree."""

import numpy as np
import pytest

from lab.captures.outdoors import outdoor_capture, photograph, sky_colors


@pytest.fixture(scope="module")
def made():
    return outdoor_capture(64, 48, 8, points=400)


def test_the_sky_has_the_colours_of_its_directions(made):
    for view, sky in zip(made.views, made.sky, strict=True):
        rows, columns = np.nonzero(sky)
        c = view.camera
        rays = np.stack([(columns - c.cx) / c.fx, (rows - c.cy) / c.fy, np.ones(len(rows))], axis=1) @ c.R
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        error = np.abs(view.image[sky] / 255 - sky_colors(rays)).max(axis=1)
        assert np.median(error) < 0.01 and rays[:, 1].max() < 0.02


def test_points_lie_where_the_photos_show_them(made):
    assert made.points.shape == (400, 3) and made.points[:, 1].max() < 1e-6, "none below the ground"
    each = 400 // len(made.views)
    errors = []
    for index, view in enumerate(made.views):
        part = slice(index * each, (index + 1) * each)
        u, v, z = view.camera.project(view.camera.world_to_cam(made.points[part]))
        assert (z > 0).all()
        shown = view.image[np.rint(v).astype(int), np.rint(u).astype(int)] / 255
        errors.append(np.abs(shown - made.colors[part]).max(axis=1))
    assert np.median(np.concatenate(errors)) < 0.05


def test_the_capture_can_have_another_photo_and_a_dome(made):
    image, sky = photograph(made.views[2].camera)
    np.testing.assert_array_equal(image, made.views[2].image)
    np.testing.assert_array_equal(sky, made.sky[2])
    dome = outdoor_capture(64, 48, 8, points=400, dome=12.0)
    assert any((a.image != b.image).any() for a, b in zip(dome.views, made.views, strict=True))
    plain = outdoor_capture(64, 48, 2, points=40, clouds=0.0)
    assert np.ptp(plain.views[0].image[plain.sky[0]].astype(int), axis=0).max() < 60
    assert np.median(plain.views[0].image[plain.sky[0]]) == round(255 * 0.97)

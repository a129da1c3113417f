"""The house in the garden: its photos are geometrically exact, the same every time, and show what they name."""

import numpy as np
import pytest

from lab.captures.garden import (
    GARDEN_DISTANCE,
    GARDEN_TARGET,
    SOLIDS,
    garden_camera,
    photograph_garden,
)
from lab.captures.garden_paint import MATERIALS, SUN, noise_tile, sky_colors

SIZE = 96, 72


def pixel_of(camera, point):
    """Return column and row of the pixel that shows a point."""
    x, y, z = camera.R @ (np.array(point) - camera.eye)
    return round(camera.fx * x / z + camera.cx), round(camera.fy * y / z + camera.cy)


@pytest.fixture(scope="module")
def front():
    camera = garden_camera(0.15, 0.28, SIZE)
    return camera, photograph_garden(camera)


def test_a_camera_looks_at_the_house_from_its_distance():
    for azimuth in (0.0, 1.0, 4.0):
        camera = garden_camera(azimuth, 0.3, SIZE)
        assert np.isclose(np.linalg.norm(camera.eye - GARDEN_TARGET), GARDEN_DISTANCE)
        x, y, z = camera.R @ (GARDEN_TARGET - camera.eye)
        assert np.allclose([x, y], 0, atol=1e-12) and z > 0
        assert np.isclose(camera.eye[1], GARDEN_TARGET[1] - GARDEN_DISTANCE * np.sin(0.3))
    assert garden_camera(0.0).eye[2] > 0.7, "azimuth 0 faces the door"


@pytest.mark.parametrize(
    ("point", "name"),
    [
        ((0.0, -1.2, 0.32), "roof"),
        ((0.25, -0.45, 0.7), "brick"),
        ((0.48, -0.4, 0.7), "glass"),
        ((0.75, 0.0, 1.25), "grass"),
        ((1.3, -0.35, 1.91), "fence"),
        ((-1.55, -1.1, 0.95), "leaves"),
    ],
)
def test_a_place_is_where_the_camera_sees_it(front, point, name):
    camera, photo = front
    column, row = pixel_of(camera, point)
    near = photo.material[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    assert MATERIALS.index(name) in near, [MATERIALS[k] for k in np.unique(near)]


def test_photos_are_the_same_every_time_and_views_agree(front):
    camera, photo = front
    again = photograph_garden(camera)
    assert np.array_equal(photo.image, again.image) and np.array_equal(photo.material, again.material)
    # A point of the roof has one colour, from wherever it is seen.
    other = garden_camera(-0.25, 0.4, SIZE)
    seen = photograph_garden(other)
    gaps = []
    for x in np.linspace(-0.8, 0.4, 9):
        point = (x, -1.15, 0.382)
        (a, b), (c, d) = pixel_of(camera, point), pixel_of(other, point)
        roof = MATERIALS.index("roof")
        assert photo.material[b, a] == roof and seen.material[d, c] == roof
        blocks = [
            image[r - 1 : r + 2, q - 1 : q + 2].mean(axis=(0, 1))
            for image, r, q in ((photo.image.astype(float), b, a), (seen.image.astype(float), d, c))
        ]
        gaps.append(np.abs(blocks[0] - blocks[1]).mean())
    assert np.median(gaps) < 20 < photo.image.std()


def test_materials_cover_the_photos_of_a_walk():
    shown = np.zeros(len(MATERIALS))
    for azimuth in np.linspace(0, 2 * np.pi, 6, endpoint=False):
        material = photograph_garden(garden_camera(azimuth, 0.18, SIZE)).material
        shown += np.bincount(material.ravel(), minlength=len(MATERIALS))
    assert (shown > 0).all()
    assert 0.02 < shown[MATERIALS.index("sky")] / shown.sum() < 0.4


def test_rays_that_hit_a_solid_end_on_its_surface():
    rng = np.random.default_rng(0)
    hits = 0
    for solid in SOLIDS:
        middle = (solid.low + solid.high) / 2
        eye = (middle + 6 * np.array([0.3, -0.5, 0.81]))[:, None].astype(np.float32)
        rays = (middle + rng.uniform(-0.5, 0.5, (60, 3)) * (solid.high - solid.low)).T.astype(
            np.float32
        ) - eye
        at = solid.hit(eye, rays)
        points = (eye + at * rays)[:, np.isfinite(at)]
        hits += points.shape[1]
        if len(solid.normals):
            apart = (solid.normals @ points - solid.offsets[:, None]).max(axis=0)
        else:
            half = (solid.high - solid.low)[:, None] / 2
            apart = np.linalg.norm((points - middle[:, None]) / half, axis=0) - 1
        assert np.allclose(apart, 0, atol=1e-3)  # float32 over a distance of six, half axes of 0.15
        facing = (solid.normals_at(points) * rays[:, np.isfinite(at)]).sum(axis=0)
        assert (facing < 0).all()
        assert np.isinf(solid.hit(eye, -rays)).all(), "nothing lies behind"
    assert hits > 20 * len(SOLIDS)


def test_the_house_throws_a_shadow_away_from_the_sun():
    camera = garden_camera(np.pi, 0.3, SIZE)  # behind the house, where the sun is in front
    image = photograph_garden(camera).image.astype(float)
    dark = pixel_of(camera, (0.0, 0.0, -1.0))
    bright = pixel_of(camera, (0.2, 0.0, -1.55))
    assert SUN[2] > 0, "the shadow lies at negative z"
    light = [image[r - 1 : r + 2, c - 1 : c + 2].mean() for c, r in (dark, bright)]
    assert light[0] < 0.75 * light[1]


def test_noise_repeats_without_a_seam_and_the_sky_is_blue_above():
    tile = noise_tile()
    inner = np.abs(np.diff(tile, axis=1)).mean()
    assert np.abs(tile[:, 0] - tile[:, -1]).mean() < 1.5 * inner
    assert np.abs(tile[0] - tile[-1]).mean() < 1.5 * np.abs(np.diff(tile, axis=0)).mean()
    above = sky_colors(np.array([[0.0], [-1.0], [0.0]], np.float32))[:, 0]
    assert above[2] > above[0]

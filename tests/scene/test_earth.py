"""Where on earth a scene is: geodesy against known places, moves, and the text that files store."""

from dataclasses import replace

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.edit import Similarity
from gsplat_edu.scene.earth import Earth, code_of, earth_centred, geodetic, local_axes
from scene_files import random_scene

UTM = "EPSG:32633"

PLACES = [(0.0, 0.0, 0.0), (47.3769, 8.5417, 408.0), (-33.86, 151.21, -20.0), (89.9, -120.0, 3000.0)]


@pytest.mark.parametrize("place", PLACES)
def test_latitude_and_height_are_found_again(place):
    found = geodetic(earth_centred([place])[0])
    np.testing.assert_allclose(found, place, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found[:2], place[:2], rtol=0, atol=1e-9)


def test_the_ellipsoid_has_its_semi_axes():
    equator, pole = earth_centred([(0.0, 90.0, 0.0), (90.0, 0.0, 0.0)])
    np.testing.assert_allclose(equator, (0.0, 6_378_137.0, 0.0), atol=1e-8)
    np.testing.assert_allclose(pole, (0.0, 0.0, 6_356_752.314245), atol=1e-6)


@pytest.mark.parametrize("place", PLACES)
def test_local_axes_are_those_of_small_steps(place):
    """Central differences in latitude, longitude and height; at 1e-5 degrees their error is below 1e-6."""
    step = np.diag([1e-5, 1e-5, 1.0])
    east, north, up = local_axes(*place[:2])
    ends = [earth_centred([place + s])[0] - earth_centred([place - s])[0] for s in step]
    for axis, end in zip((north, east, up), ends, strict=True):
        np.testing.assert_allclose(end / np.linalg.norm(end), axis, atol=1e-6)


def test_a_moved_scene_stays_where_it_is():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    move = Similarity(turn * np.sign(np.linalg.det(turn)), 2.5, np.array([3.0, -8.0, 1.0]))
    earth = Earth.at_place(47.0, 8.0, 400.0)
    scene = replace(random_scene(20, 0), origin=(7e4, -2e4, 10.0), earth=earth)
    moved = move.scene(scene)
    for one, other in zip(scene.gaussians.means.double(), moved.gaussians.means.double(), strict=True):
        before, after = (
            each.earth.rows @ [*(np.array(each.origin) + mean.numpy()), 1.0]
            for each, mean in ((scene, one), (moved, other))
        )
        # float32 resolves 2.5 * 3 to 2^-22; in metres that is 1e-7
        np.testing.assert_allclose(before, after, rtol=0, atol=1e-5)


def test_files_store_it_exactly():
    earth = Earth.at_place(47.3769, 8.5417, 408.123)
    assert Earth.parsed(str(earth)) == earth
    assert Earth.parsed(None) is None


@pytest.mark.parametrize(
    "text",
    ["", "here 1 2 3", f"{UTM} 1 2 3", f"{UTM} {'nan ' * 12}", f"{UTM} {'x ' * 12}", f"{UTM} {'1 ' * 13}"],
)
def test_text_that_is_no_place_is_refused(text):
    with pytest.raises(ArgumentError):
        Earth.parsed(text)


def test_codes_are_found_in_well_known_text():
    text = (
        'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",AUTHORITY["EPSG","4326"]],AUTHORITY["EPSG","32633"]]'
    )
    assert code_of(text) == code_of(f" {UTM}\n") == code_of('PROJCRS["x",ID["EPSG",32633]]') == UTM
    assert code_of('LOCAL_CS["Local Coordinates (m)"]') is None


def test_places_are_said_in_degrees_or_in_their_system():
    assert Earth.at_place(47.3769, 8.5417, 408.0).place_of((0, 0, 0)) == (
        "47.376900, 8.541700 degrees, 408.0 m above the ellipsoid (WGS 84)"
    )
    utm = Earth.of(np.eye(3), (5e5, 4.6e6, 100.0), UTM)
    assert utm.place_of((1, 2, 3)) == f"500001.00 east, 4600002.00 north, 103.00 up in {UTM}"

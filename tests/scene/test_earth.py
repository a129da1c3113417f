"""Where on earth a scene is: geodesy against known places, moves, and the text that files store."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.edit import Similarity
from gsplat_edu.scene.earth import (
    EARTH_CENTRED,
    Earth,
    code_of,
    converted,
    earth_centred,
    geodetic,
    local_axes,
)
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


def test_places_are_said_in_degrees_and_in_their_system():
    assert Earth.at_place(47.3769, 8.5417, 408.0).place_of((0, 0, 0)) == (
        "47.376900, 8.541700 degrees, 408.0 m above the ellipsoid (WGS 84)"
    )
    utm = Earth.of(np.eye(3), (499_999.0, -2.0, 100.0), UTM)  # zone 33 has its middle at 15 degrees
    said = f"500000.00 east, 0.00 north, 103.00 up in {UTM}"
    assert utm.place_of((1, 2, 3)) == f"{said}: 0.000000, 15.000000 degrees"
    assert (
        Earth.of(np.eye(3), (1, 2, 3), "EPSG:1").place_of((0, 0, 0))
        == "1.00 east, 2.00 north, 3.00 up in EPSG:1"
    )


def test_a_projected_system_comes_to_the_globe_with_its_scale():
    """Along the middle of a zone, a metre of UTM is 1 / 0.9996 m on the ellipsoid (Snyder 1987, p. 57)."""
    globe = Earth.of(np.eye(3), (5e5, 0.0, 0.0), UTM).on_globe((0, 0, 0))
    assert globe.crs == EARTH_CENTRED and globe.on_globe((1, 2, 3)) is globe
    np.testing.assert_allclose(globe.rows[:, 3], earth_centred([(0.0, 15.0, 0.0)])[0], atol=1e-6)
    stretched = local_axes(0.0, 15.0).T @ np.diag([1 / 0.9996, 1 / 0.9996, 1.0])
    np.testing.assert_allclose(globe.rows[:, :3], stretched, atol=1e-8)


def test_the_map_on_the_globe_errs_by_the_curvature_of_the_earth():
    earth, at = Earth.of(np.eye(3), (3e5, 5.3e6, 400.0), UTM), np.array([100.0, -50.0, 20.0])
    globe = earth.on_globe(at)
    for distance, most in ((0.0, 1e-8), (1000.0, 0.1)):
        place = at + distance * np.array([0.6, 0.8, 0.0])
        exact = converted([earth.rows @ [*place, 1.0]], UTM, EARTH_CENTRED)[0]
        apart = float(np.linalg.norm(globe.rows @ [*place, 1.0] - exact))
        assert apart <= most and (distance == 0.0 or apart > 0.05)


def test_places_of_another_system_come_back_to_the_scene():
    earth = Earth.at_place(47.0, 15.3, 400.0, np.diag([2.0, 2.0, 2.0]))
    positions = np.array([[0.0, 0.0, 0.0], [30.0, -20.0, 5.0], [np.nan, 0.0, 0.0]])
    places = converted((positions @ earth.rows[:, :3].T) + earth.rows[:, 3], EARTH_CENTRED, UTM)
    assert 5.2e5 < places[0, 0] < 5.25e5 and abs(places[0, 2] - 400.0) < 1e-6
    found = earth.positions_of(places, UTM)
    np.testing.assert_allclose(found[:2], positions[:2], atol=1e-6)
    assert not np.isfinite(found[2]).all()
    with pytest.raises(ArgumentError, match="singular"):
        Earth.of(np.zeros((3, 3)), (0, 0, 0)).positions_of(places, UTM)


@pytest.mark.parametrize(
    ("crs", "place", "words"),
    [
        ("EPSG:999999", (0, 0, 0), "EPSG:999999: PROJ does not know it"),
        (UTM, (1e30, 1e30, 0), f"{UTM}: PROJ cannot convert its places to EPSG:4978"),
    ],
)
def test_what_proj_cannot_convert_costs_one_line(crs, place, words):
    with pytest.raises(ArgumentError, match=words) as caught:
        converted([place], crs, EARTH_CENTRED)
    assert "\n" not in str(caught.value)


@pytest.mark.own_process
def test_without_pyproj_places_of_maps_are_said_without_degrees():
    words = f"""import sys
sys.modules["pyproj"] = None
from gsplat_edu.scene.earth import Earth
utm = Earth.parsed("{UTM} 1 0 0 500000 0 1 0 0 0 0 1 0")
print(utm.place_of((0, 0, 0)))
try: utm.on_globe((0, 0, 0))
except Exception as error: print(error)"""
    said = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    first, second = said.stdout.splitlines()
    assert first == f"500000.00 east, 0.00 north, 0.00 up in {UTM}"
    assert (
        second.startswith(f"{UTM}: needs pyproj, which is not installed: pip install") and "[scans]" in second
    )

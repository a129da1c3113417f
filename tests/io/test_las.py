"""LAS and LAZ of splats' centres: places, colours, opacities and reference systems, as laspy reads them."""

import subprocess
import sys
from dataclasses import replace

import laspy
import numpy as np
import pytest
import torch

from gsplat_edu.base.constants import C0
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.data.point_files import read_points
from gsplat_edu.io.formats import losses, read_scene, write_scene
from gsplat_edu.io.las import LARGEST, LEAST_OPACITY, SMALLEST_REACH, step_of
from gsplat_edu.scene.earth import EARTH_CENTRED, Earth, converted
from scene_files import random_scene

UTM = "EPSG:32633"

TURNED = np.array([[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 2.0]])


def solid_rows(scene):
    """Return which splats are points."""
    opacities = 1.0 / (1.0 + np.exp(-scene.gaussians.logit_opacities.double().numpy()))
    assert np.abs(opacities - LEAST_OPACITY).min() > 1e-6  # float32 cannot decide otherwise
    return opacities >= LEAST_OPACITY, opacities


def written(path, scene):
    write_scene(path, scene)
    return laspy.read(path)


@pytest.fixture
def scene():
    """200 splats, half of them nearly transparent."""
    made = random_scene(200, 3)
    logits = torch.linspace(-8.0, 4.0, 200)
    return replace(made, gaussians=replace(made.gaussians, logit_opacities=logits))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_centres_colours_and_system_are_those_of_the_scene(tmp_path, scene, suffix):
    origin = np.array([5e6, -4e6, 300.0])
    scene = replace(scene, origin=tuple(origin), earth=Earth.of(TURNED, (4e5, 5e6, 20.0), UTM))
    file = written(tmp_path / f"a{suffix}", scene)
    solid, opacities = solid_rows(scene)
    assert 0 < solid.sum() < 200
    expected = (scene.gaussians.means.double().numpy()[solid] + origin) @ TURNED.T + (4e5, 5e6, 20.0)
    # half a step by rounding; doubles of 1.4e7 resolve 2e-9
    step = file.header.scales.max()
    assert step <= 1e-4
    np.testing.assert_allclose(file.xyz, expected, rtol=0, atol=0.5 * step + 1e-8)
    colors = np.clip(0.5 + C0 * scene.gaussians.sh0[:, 0].double().numpy()[solid], 0.0, 1.0)
    rgb = np.stack([file.red, file.green, file.blue], axis=1) / 65535.0
    np.testing.assert_allclose(rgb, colors, rtol=0, atol=0.5 / 65535.0 + 1e-9)
    # float32's sigmoid errs by a few times 2^-24
    np.testing.assert_allclose(file.intensity / 65535.0, opacities[solid], rtol=0, atol=0.5 / 65535.0 + 1e-6)
    (text,) = (vlr.string for vlr in file.header.vlrs if hasattr(vlr, "string"))
    assert text.startswith("PROJCS[") and file.header.global_encoding.wkt  # WKT 1, as LAS 1.4 asks
    found = read_points(tmp_path / f"a{suffix}")
    assert found.crs == UTM
    np.testing.assert_array_equal(found.points, np.asarray(file.xyz))
    assert (file.header.version.major, file.header.version.minor, file.header.point_format.id) == (1, 4, 7)
    assert (file.return_number == 1).all() and (file.number_of_returns == 1).all()


@pytest.mark.parametrize(
    ("latitude", "longitude", "crs"),
    [(47.0, 15.3, UTM), (-33.9, 151.2, "EPSG:32756"), (1.0, 180.0, "EPSG:32660")],
)
def test_earth_centred_places_become_utm_with_heights(tmp_path, scene, latitude, longitude, crs):
    earth = Earth.at_place(latitude, longitude, 400.0)
    scene = replace(scene, earth=earth)
    file = written(tmp_path / "a.laz", scene)
    assert read_points(tmp_path / "a.laz").crs == crs
    back = converted(file.xyz, crs, EARTH_CENTRED)
    expected = (
        scene.gaussians.means.double().numpy()[solid_rows(scene)[0]] @ earth.rows[:, :3].T + earth.rows[:, 3]
    )
    np.testing.assert_allclose(back, expected, rtol=0, atol=1e-3)
    assert np.abs(np.median(file.z) - 400.0) < 5.0


def test_without_a_place_on_earth_coordinates_are_the_scenes_own(tmp_path, scene):
    scene = replace(scene, origin=(7e6, 5e5, -3.0), up=(0.0, 0.6, 0.8), unit="cm")
    file = written(tmp_path / "a.las", scene)
    expected = scene.gaussians.means.double().numpy()[solid_rows(scene)[0]] + scene.origin
    np.testing.assert_allclose(file.xyz, expected, rtol=0, atol=0.5e-4 + 1e-8)
    assert file.header.parse_crs() is None and not file.header.vlrs
    said = "\n".join(losses(tmp_path / "a.las", scene))
    left_out = 200 - len(file.points)
    assert f"{left_out} of 200 splats have an opacity below 0.05 and are left out" in said
    assert "coordinates are the scene's own, because its place on earth is not known" in said
    placed = replace(scene, earth=Earth.at_place(47.0, 8.0, 400.0))
    assert not any("place on earth" in line for line in losses(tmp_path / "a.las", placed))


def test_the_same_scene_gives_the_same_bytes(tmp_path, scene):
    """Today's date is not in the file."""
    for name in ("a.laz", "b.laz"):
        write_scene(tmp_path / name, scene)
    assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()
    assert laspy.read(tmp_path / "a.laz").header.creation_date.year == 2000


def test_steps_fit_the_integers_and_are_fine():
    for reach in (0.0, 1e-9, 0.02, 0.9, 7.0, 10.0, 150.0, 2.1e5, 2.2e5, 1e9, 1e30):
        step = step_of(reach)
        assert reach / step <= LARGEST
        assert step <= max(1e-4, 10.0 * reach / LARGEST)
        assert step <= 1.000001e-6 * max(reach, SMALLEST_REACH) or reach >= 2e5


def test_what_cannot_be_written_is_one_line(tmp_path, scene):
    haze = scene.gaussians.logit_opacities - 20.0
    with pytest.raises(ArgumentError, match=r"a\.las: no splat has an opacity of 0\.05"):
        write_scene(
            tmp_path / "a.las", replace(scene, gaussians=replace(scene.gaussians, logit_opacities=haze))
        )
    unknown = replace(scene, earth=Earth.of(np.eye(3), (0, 0, 0), "EPSG:999999"))
    with pytest.raises(ArgumentError, match=r"a\.las: PROJ does not know the scene's system EPSG:999999"):
        write_scene(tmp_path / "a.las", unknown)
    assert not list(tmp_path.iterdir())


def test_a_point_cloud_is_no_scene(tmp_path, scene):
    write_scene(tmp_path / "a.laz", scene)
    with pytest.raises(
        SceneFormatError, match=r"a\.laz: is a point cloud, not a scene; give it to a training as `points`$"
    ):
        read_scene(tmp_path / "a.laz")


@pytest.mark.own_process
def test_without_the_library_a_line_names_the_extra(tmp_path):
    words = """import importlib.util, sys
from pathlib import Path
sys.modules["laspy"] = None
from gsplat_edu.viewer.export import check_target
try: check_target("OUT", Path("a.laz"))
except Exception as error: print(error)"""
    said = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert "OUT: a.laz: needs laspy and pyproj" in said.stdout and "[scans]" in said.stdout

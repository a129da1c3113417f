"""OpenSfM's reconstruction.json: every projection that it has, the largest reconstruction, and a real one."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from data.pose_programs import CAMERAS, COLORS, POINTS, H, W, assert_reads, assert_refused, write_opensfm
from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.conventions import READINGS, read_as
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.panorama import FACES
from gsplat_edu.data.reader import read_capture
from gsplat_edu.scene.earth import Earth

FISHEYE = ("k1", "k2", "k3", "k4", "p1", "p2", "s0", "s2")
TWO = {"focal_x": 0.9, "focal_y": 0.8, "c_x": 0.02, "c_y": -0.03}
RADIAL = {"k1": -0.1, "k2": 0.02, "k3": -0.004}
TANGENTIAL = {"p1": 0.003, "p2": -0.002}


def tangential(x, y, p1, p2):
    q = x * x + y * y
    return 2 * p1 * x * y + p2 * (q + 2 * x * x), 2 * p2 * x * y + p1 * (q + 2 * y * y)


def perspective(x, y, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0):
    q = x * x + y * y
    d = 1 + k1 * q + k2 * q**2 + k3 * q**3
    a, b = tangential(x, y, p1, p2)
    return d * x + a, d * y + b


def fisheye(x, y, **given):
    k1, k2, k3, k4, p1, p2, s0, s2 = (given.get(name, 0.0) for name in FISHEYE)
    r = np.hypot(x, y)
    theta = np.arctan(r)
    h, w, q = x * theta / r, y * theta / r, theta**2
    a, b = tangential(h, w, p1, p2)
    d = 1 + k1 * q + k2 * q**2 + k3 * q**3 + k4 * q**4
    return d * h + a + s0 * q, d * w + b + s2 * q


@pytest.mark.parametrize(
    ("kind", "numbers", "formula"),
    [
        ("perspective", {"focal": 0.9, "k1": -0.1, "k2": 0.02}, perspective),
        ("simple_radial", {**TWO, "k1": -0.1}, perspective),
        ("radial", {**TWO, "k1": -0.1, "k2": 0.02}, perspective),
        ("brown", {**TWO, **RADIAL, **TANGENTIAL}, perspective),
        ("fisheye", {"focal": 0.9, "k1": -0.1, "k2": 0.02}, fisheye),
        ("fisheye_opencv", {**TWO, **RADIAL, "k4": 0.001}, fisheye),
        ("fisheye62", {**TWO, **RADIAL, **TANGENTIAL, "k4": 0.001}, fisheye),
        ("fisheye624", {**TWO, **RADIAL, **TANGENTIAL, "s0": 0.002, "s2": -0.001}, fisheye),
    ],
)
def test_poses_points_and_lenses(tmp_path, kind, numbers, formula):
    def seen(x, y):
        a, b = formula(x, y, **{k: v for k, v in numbers.items() if k[0] in "kps"})
        fx = numbers.get("focal_x", numbers.get("focal"))
        fy = numbers.get("focal_y", fx)
        u, v = fx * a + numbers.get("c_x", 0.0), fy * b + numbers.get("c_y", 0.0)
        return (
            u * W + W / 2,
            v * W + H / 2,
        )  # the documentation's (w - 1) / 2 counts from the first pixel's centre

    write_opensfm(tmp_path, camera={"projection_type": kind, **numbers})
    capture = assert_reads(tmp_path, "OpenSfM", seen)
    np.testing.assert_allclose(capture.cloud.points, POINTS, rtol=0, atol=1e-12)
    np.testing.assert_allclose(capture.cloud.colors[0], np.array(COLORS) / 255, rtol=0, atol=1e-12)
    assert [str(note) for note in capture.notes] == ["poses of OpenSfM: 6 of 6 photos"]


def test_panoramas(tmp_path):
    write_opensfm(tmp_path, camera={"projection_type": "spherical", "width": 64, "height": 32})
    for name, _, _ in CAMERAS:
        Image.new("RGB", (64, 32)).save(tmp_path / "images" / name)
    capture = read_capture(tmp_path)
    assert len(capture.frames) == FACES * len(CAMERAS)
    assert str(capture.notes[0]) == "poses of OpenSfM: 6 of 6 photos"


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (
            {"projection_type": "dual", "focal": 0.9},
            "the projection 'dual' has no model here; undistort with",
        ),
        ({"projection_type": "fisheye62", **TWO, "k5": 0.1}, "'fisheye62' with k5 has no model here"),
        ({"projection_type": "brown"}, "its camera has no focal length"),
        ({"projection_type": "perspective", "focal": -1.0}, "focal length fx is"),
    ],
)
def test_a_lens_without_a_model_is_named(tmp_path, camera, says):
    write_opensfm(tmp_path, camera=camera)
    with pytest.raises(DatasetError, match=re.escape(says)) as caught:
        read_capture(tmp_path)
    assert "reconstruction.json, photo shot_0.png: " in str(caught.value) and "\n" not in str(caught.value)


def test_of_several_reconstructions_the_largest_is_read(tmp_path):
    small = {"cameras": {}, "shots": {"x.jpg": {"camera": "c", "rotation": [0, 0, 0]}}}
    write_opensfm(tmp_path, extra=[small])
    said = [str(note) for note in read_capture(tmp_path).notes]
    assert said == [
        "poses of OpenSfM: 6 of 6 photos",
        "reconstruction.json holds 2 reconstructions: that of 6 photos is read, those of 1 are not",
    ]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c[0].pop("shots"), "lacks 'shots'"),
        (lambda c: c[0]["shots"].clear(), "has no posed photo"),
        (lambda c: c[0]["shots"]["shot_0.png"].update(rotation=[1, 2]), "has to have 3 entries"),
        (
            lambda c: c[0]["shots"]["shot_0.png"].update(rotation="north"),
            "shot shot_0.png: rotation: is .north., but has to be a list",
        ),
        (lambda c: c[0]["shots"]["shot_0.png"].update(translation=[0, 0, float("nan")]), "NaN"),
        (lambda c: c[0]["points"]["3"].pop("coordinates"), "lacks 'coordinates'"),
        (lambda c: c.clear(), "has no posed photo"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, change, says):
    write_opensfm(tmp_path)
    assert_refused(tmp_path / "reconstruction.json", change, says)


def test_a_real_reconstruction(real):
    dataset = load_dataset(real("poses") / "opensfm")
    assert len(dataset.train) + len(dataset.test) == 19 and dataset.points.shape == (1191, 3)
    assert "poses of OpenSfM: 19 of 23 photos" in map(str, dataset.notes)
    views = (*dataset.train, *dataset.test)
    inside = []
    for view in views:
        seen = (dataset.points - view.camera.eye) @ view.camera.R.T
        u, v = (view.camera.intrinsics.K @ (seen / seen[:, 2:]).T)[:2]
        inside.append(((seen[:, 2] > 0) & (abs(u - 500) < 500) & (abs(v - 375) < 375)).mean())
    assert min(inside) > 0.2 and np.mean(inside) > 0.6


def test_the_reference_says_where_on_earth_the_zero_is(tmp_path):
    write_opensfm(tmp_path)
    path = tmp_path / "reconstruction.json"
    (one,) = json.loads(path.read_text())
    for place, known in (((47.0, 8.0, 400.0), True), ((0.0, 0.0, 0.0), False)):
        one["reference_lla"] = dict(zip(("latitude", "longitude", "altitude"), place, strict=True))
        path.write_text(json.dumps([one]))
        scale = read_capture(tmp_path).scale
        assert (scale is not None) == known
        if known:
            assert scale.unit == "m"
            assert scale.earth == Earth.at_place(*place)


@pytest.mark.parametrize(
    ("reading", "stays"),
    [("k1 and k2 are exchanged", True), ("the matrices are inverted", False)],
)
def test_a_place_on_earth_is_dropped_where_poses_are_read_into_another_world(tmp_path, reading, stays):
    write_opensfm(tmp_path)
    path = tmp_path / "reconstruction.json"
    (one,) = json.loads(path.read_text())
    one["reference_lla"] = {"latitude": 47.0, "longitude": 8.0, "altitude": 400.0}
    path.write_text(json.dumps([one]))
    name = next(name for name in READINGS if name.startswith(reading))
    found = read_as(read_capture(tmp_path), name)
    assert found.scale.unit == "m"
    assert found.scale.earth == (Earth.at_place(47.0, 8.0, 400.0) if stays else None)

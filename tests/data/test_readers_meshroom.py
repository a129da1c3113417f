"""Meshroom's cameras.sfm: the versions of its lenses, points, rigs and damage."""

import json

import numpy as np
import pytest

from data.pose_programs import POINTS, SFM_LENS, H, W, assert_reads, assert_refused, write_meshroom
from data.test_readers_openmvg import brown, fisheye
from gsplat_edu.data.reader import read_capture

BROWN = (-0.1, 0.02, -0.004, 0.003, -0.002)
CORNER = ["12.4", "8.7"]


@pytest.mark.parametrize(
    ("version", "lens", "fy"),
    [
        ("1 0 0", {"pxFocalLength": "20", "principalPoint": CORNER}, 20.0),
        ("1 2 0", {"pxFocalLength": ["20", "21"], "principalPoint": CORNER}, 21.0),
        ("1 2 1", {"pxFocalLength": ["20", "21"]}, 21.0),
        ("1 2 4", {"pixelRatio": "0.8"}, 25.0),
        ("1 2 5", {}, 21.0),
        ("1 2 13", {"pixelRatio": 1.05, "focalLength": 30.0}, 21.0),
    ],
)
def test_poses_points_and_lenses_of_each_version(tmp_path, version, lens, fy):
    def seen(x, y):
        a, b = brown(x, y, *BROWN)
        return 20 * a + W / 2 + 0.4, fy * b + H / 2 - 0.3

    write_meshroom(tmp_path, lens={**SFM_LENS, **lens}, version=version)
    capture = assert_reads(tmp_path, "Meshroom", seen)
    np.testing.assert_allclose(capture.cloud.points, POINTS, rtol=0, atol=1e-12)
    np.testing.assert_allclose(capture.cloud.colors[0], [1, 128 / 255, 0], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "numbers", "formula"),
    [
        ("none", [], brown),
        ("radialk1", [-0.1], brown),
        ("radialk3", [-0.1, 0.02, -0.004], brown),
        ("fisheye4", [-0.05, 0.01, -0.002, 0.001], fisheye),
    ],
)
@pytest.mark.parametrize("old", [False, True])
def test_distortions(tmp_path, kind, numbers, formula, old):
    def seen(x, y):
        a, b = formula(x, y, *numbers)
        return 20 * a + W / 2 + 0.4, 21 * b + H / 2 - 0.3

    names = {"none": "pinhole", "radialk1": "radial1", "radialk3": "radial3"}
    model = {"type": names.get(kind, kind), "distortionType": ""} if old else {"distortionType": kind}
    params = list(map(str, numbers)) or ""  # the program writes an empty list as an empty text
    write_meshroom(tmp_path, lens={**SFM_LENS, **model, "distortionParams": params})
    assert_reads(tmp_path, "Meshroom", seen)


def test_a_photo_of_a_rig_is_left_out(tmp_path):
    write_meshroom(tmp_path)
    path = tmp_path / "cameras.sfm"
    contents = json.loads(path.read_text())
    contents["views"][0] |= {"rigId": "3", "subPoseId": "0", "isPoseIndependant": "false"}
    path.write_text(json.dumps(contents))
    capture = read_capture(tmp_path)
    assert len(capture.frames) == 5
    assert any("its pose is that of a rig" in str(note) for note in capture.notes)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("views"), "lacks 'views'"),
        (lambda c: c.pop("poses"), "has no posed view; give the cameras.sfm"),
        (lambda c: c["poses"][0]["pose"]["transform"]["rotation"].pop(), "pose 40, rotation: .* 9 numbers"),
        (
            lambda c: c["poses"][0]["pose"]["transform"].update(center=["1", "nan", "2"]),
            "40, center: .* 3 num",
        ),
        (lambda c: c["intrinsics"][0].update(width="0"), "intrinsic 7: its size 0x18 is no photo's"),
        (
            lambda c: c["intrinsics"][0].update(sensorWidth="0"),
            "sensorWidth and pixelRatio have to be above 0",
        ),
        (lambda c: c["intrinsics"][0].pop("focalLength"), "intrinsic 7: lacks 'focalLength'"),
        (lambda c: c.update(version=["1", "0", "0"]), "intrinsic 7: lacks 'pxFocalLength'"),
        (lambda c: c["intrinsics"][0].update(distortionType="3deradial4"), "'3deradial4' has no model here"),
        (lambda c: c["intrinsics"][0].update(distortionParams=["1"]), "'brown' has 1 coefficients, not 5"),
        (lambda c: c["structure"][1].update(X=["0", "0"]), "point: .* 3 numbers"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, change, says):
    write_meshroom(tmp_path)
    assert_refused(tmp_path / "cameras.sfm", change, says)
